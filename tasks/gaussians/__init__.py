"""3D Gaussians: how they are rendered and trained, whatever they show. No module here is a step.

1. Sets of Gaussians: `initialise` makes them from points, joins and picks them; `read_ply` reads them. `harmonics`:
   their colours.
2. Rendering: `rasterize`, with gradients, by `native_pass` and `autograd` (the C++ in `native/`, loaded by `library`)
   or by `cuda` (gsplat). `render`, and `torch_render` on a device: without gradients.
3. What is trained on: `views`, the pixels of each view that count; `objective`, what a training makes small.
4. `trainer`: the loop. In each step `losses`, `optimizer` with its `learning_rates`, and `densification`; all on one of
   two `backends`, NumPy's there and `torch_backend`.
"""
