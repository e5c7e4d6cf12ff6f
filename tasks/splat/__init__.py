"""Splat (Sec. 3.2): instances become Gaussians, each on its own, and these one scene.

The steps, in the order in which they run:

1. `reconstruct` (Sec. 3.2.1): each instance, and the background, trained from its own pixels. `consensus`: which of
   these count.
2. `refine` (Sec. 3.2.2): the masks of each instance, compared with what its Gaussians show.
3. `resolve`: refined masks that overlap made exclusive. `retrain`, in `reconstruct`: once more, where masks changed.
4. `plan`, `merge` (Sec. 3.2.3, Eq. 4 to 6): which instances collide, and the training of such a pair, until none is
   left; not in `default`, which has no such rounds. `collisions`: how boxes overlap. `guard`: a training that makes
   things worse is undone, here and in 5.
5. `global_pass`: all together on whole photos. What it asks of the scene: `relabel`, `side_views`, `strays`.
6. `render_masks`, with `photo_borders`: the instances that the scene shows in each view.

`label`, in the place of all that: the instances of a scene that was trained elsewhere.
"""
