"""Semantics (Sec. 5.2): instances -> descriptors -> what a text means.

1. `describe`: a vector for each instance (f_obj), by one of the `encoders`. `part_masks`: the same for parts; `sides`:
   for what an object shows of itself from different sides.
2. `name`: a word for each. `query`: the instances that a text means.
3. `dense_describe` (appendix, Eq. 7, 8): a vector for each Gaussian.
"""
