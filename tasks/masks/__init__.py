"""What steps know of masks and of labels painted into views. No module here is a step.

- The masks of one view: `pool` (their order, tree and union), `overlap` (how far two agree), `erosion` (their
  interiors; Split&Splat, Eq. 3), `dilation`.
- Labels of points in a view: `painting` (the virtual masks, Split&Splat, M*_k), `selection` (which masks show which
  label).
"""
