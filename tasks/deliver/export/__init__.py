"""Files of other formats, of a finished run.

- Gaussians: `gaussian_ply`, `compressed_ply`, `splat`, `spz`, `sog`, `gltf`, `usda`; what they share: `content`.
- Surfaces: `mesh` makes one of an instance, `mesh_files` writes it.
- Masks: `coco`.
"""
