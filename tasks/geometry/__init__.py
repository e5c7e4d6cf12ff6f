"""What steps know of cameras, images and points. No module here is a step.

- Cameras and pixels: `cameras` (projection and back), `visibility` (Split&Splat, Eq. 1-2: the points that a view sees),
  `zbuffer` (which is in front), `lying` (whether photos stand upright).
- Images: `images` (decoding, sizes, borders), `noise`.
- Depth maps: `plane_sweep` (depth from several photos), `alignment` (a network's depth, brought to scale), `holes`,
  `fusion` (many maps, one cloud).
- Points: `clustering`, `sampling`, `shape` (sizes and planes).
- Files and libraries: `ply_elements`, `open3d`.
"""
