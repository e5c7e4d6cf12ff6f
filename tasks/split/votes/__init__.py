"""How `propagate` comes to labels: the masks of all views vote on the dense points (Split&Splat, Sec. 3.1.3).

1. `votes`: the weights w_p that points keep.
2. `in_turn`: view after view, as in the paper (Algorithm 1); or `at_once`: the masks of all views clustered.
3. What follows: `smoothing` of contested points, `touching` labels united (alike by their `color_histograms`).
"""
