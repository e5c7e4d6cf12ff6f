"""The DAGs: which tasks run on which results, and what becomes of what they give.

- The DAG of Split&Splat: `split_splat`, of `capture` (with `poses`, `depths`), `split` (with `masks`) and `splat`. In
  the place of `splat`, for a scene that was trained elsewhere: `given`.
- Its parameters: `params`; `settings` reads them from text and from `presets/`.
- What comes of a run: `deliver` writes it, `results` reads it back, `measures` and `describe` tell of it; `notebook`
  shows it.
- Flows on a finished run: `query`, `render`, `export`; `edit`, of `edit_script`, `edit_objects` and `edit_fields`;
  `evaluate`. `reproduce`: the tables of the `paper`.
- `demo`: scenes that are made up, by `generated`. `cli`: the command line. `view`: the viewer.
"""
