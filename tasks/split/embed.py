"""The segmenter's embedding of a view: made once, and prompted by every later step."""

from __future__ import annotations

from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Frame
from ss_flow.tasks.geometry.images import decode_rgb
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.onnx import network_identity
from ss_flow.tasks.models.sam import Embedding, Sam


@task(resources=Resources(cores=1, memory_mb=1500, gpus=0.1), environment=network_identity)
def embed(frame: Frame, *, model: Model, turns: int = 0, noise: float = 0.0) -> Embedding:
    """The embedding of one photo (4 MB); it takes as long as some twenty prompts.

    turns: by how many quarters, counterclockwise, the photo is turned first, to stand upright: the network knows things
    as they stand. Masks are those of the photo as it is all the same. noise: standard deviation, of 255 grey values,
    above which the network sees the photo smoothed, 0: never. Says so.
    Raises InputError when the model's files are missing, damaged or other networks.
    """
    return Sam(model).encode(decode_rgb(frame), turns, noise)
