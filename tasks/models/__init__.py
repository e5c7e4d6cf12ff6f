"""The networks that steps ask, and what stands in for them. No module here is a step.

- Where they come from: `catalogue`, `fetch`, `npm`. How they are run: `onnx`; those written down here: `onnx_graph`.
- Masks: `sam`, whose decoder is `sam_decoder`, with `sam_cells`.
- Texts and pictures: `text_image` is what is asked of each; `clip` with its `tokenizer`; `class_names`, of
  `efficientnet` and `sentences`; `colour_words`, without a network.
- Pictures alone: `patches` (a vector for each patch), `lpips` (how different two look).
"""
