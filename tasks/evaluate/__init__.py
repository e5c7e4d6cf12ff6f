"""Results against ground truth, by published protocols, and against each other.

- Instances: `instances` (on the masks of views), `points` (on annotated points: `scannet`, `replica`). Their measures:
  `contingency`, `panoptic`, `scannet_ap`.
- Texts: `lerf` on labelled frames, by the measures of `openvocab`.
- Pictures: `novel_view`, with `neighbour_colours`; `novel_objects`, thing by thing; `objects`, how clean they are.
- Two results: `comparison`.
"""
