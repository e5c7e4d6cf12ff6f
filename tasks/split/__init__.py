"""Split (Sec. 3.1): masks of single views become instances that all views agree on.

The steps, in the order in which they run; what they are made of stands in the folders beside them:

1. `embed`, `segment` or `segment_rgbd` (or `hints`, from clicks): the 2D masks of each view.
2. `dense` or `dense_splatting`: the dense points of the scene.
3. `visibility` (Eq. 1, 2): the points that each view sees. `observe` (Eq. 3): the masks that they lie under.
4. `propagate` (Algorithm 1): the views vote for the label of each point. `parts`: masks inside the masks of a label.
5. `tally`, `hierarchy`, `cut`: labels that the views show as one thing become one instance.
6. `reprompt`, `reproject`: the instances' masks in each view.
"""
