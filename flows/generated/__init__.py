"""Rooms made up by chance: photos, depth and truth of scenes of which everything is known."""

from ss_flow.flows.generated.room import Room, RoomParams, SceneObject, Views, generate, renderer_of, write_scene

__all__ = ["Room", "RoomParams", "SceneObject", "Views", "generate", "renderer_of", "write_scene"]
