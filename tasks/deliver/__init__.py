"""What users take away: the output folder, the report, pictures, films, exports.

- The folder: `output` writes it, `places` says what it may replace. Its files: `ply`, `instances_json`, `descriptors`,
  `undistorted`.
- The report: `report`, of `report_pictures`, `thumbnails`, `timeline` and `suspects`; `edit_words` for an edited scene.
- Pictures: `pictures` from any camera of `camera_paths`; `draw` for any artifact, with `point_view`, `contact_sheet`,
  `palette` and `statistics`; `compressed`: how they are kept.
- `export`: files of other formats.
"""
