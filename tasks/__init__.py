"""The algorithm: every step a pure task, in a file of its own, and what steps share.

- The steps, room by room, in the order in which data go through them: `capture`, `split`, `splat`, `semantics`; then
  `evaluate`, `deliver` and `edit`. A room knows of those before it only.
- What steps share: `geometry`, `masks`, `gaussians`, `models`; no module there is a step.
- What flows between them: `artifacts`, some of whose arrays are `packed`.
- Parameters: their `ranges`, and those that a step leaves `unread`. The machine: `device`, `processor`. Sentences:
  `words`.
"""
