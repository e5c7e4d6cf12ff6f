"""Split (Sec. 3.1): masks of single views become instances that all views agree on.

The steps, in the order in which they run:

1. `embed`, `segment`, `close_ups`, or `segment_rgbd` (or `hints`, from clicks): the 2D masks of each view. `regions`:
   what `segment_rgbd` is made of.
2. `dense` or `dense_splatting`: the dense points of the scene.
3. `visibility` (Eq. 1, 2): the points that each view sees, and `visible_by_color`: where it has no depth. `observe`
   (Eq. 3): the masks that they lie under.
4. `propagate` (Algorithm 1): the views vote for the label of each point. `votes`: how. `overlooked`: the segmenter is
   asked for things without a label of their own.
5. `tally`, `hierarchy`, `cut`: labels that the views show as one thing become one instance. `unions`: which sets of
   them are weighed. What `hierarchy` asks of labels: `agreement`, `contact`, `stuff` with `casts`, `surfaces` with
   `shadows` and `gaps`, `mounds`, `supports`, `edges`, `inlays`; `looks`: what views see at a place.
   `parts`: masks inside the masks of a label.
6. `boards`: what rises from a flat one becomes an instance. `walls`: the pieces of a wall or a floor become one.
   `correct`, with its `part_masks`: instances that the user joins or divides.
7. `reprompt`, `instances_in_view`, `reproject`: the instances' masks in each view. `confidence`: how likely each is to
   be one whole thing. `appearances`: the views that show each instance.
"""
