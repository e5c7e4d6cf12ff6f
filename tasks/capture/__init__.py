"""Capture: any layout of files -> photos, cameras and depth, which all later steps start from.

The steps, in the order in which they run:

1. `scene` finds out what lies in a folder and lists it as `scene_files`; no step yet. The layouts: `layout_colmap`,
   `layout_nerfstudio`, `layout_photos`, `layout_polycam`, `layout_replica`, `layout_scannet`, `layout_stray`,
   `layout_tum`. `names`: which files belong together. `thinning`: which views of a long recording are used.
2. `ingest`, or `video` and `recordings` where frames lie in one file: frames, and cameras that were given. What is
   known of photos: `photo_files`, `lens`, `upright`; `photo_pixels`: the way back to the photos as they were taken.
3. Without poses: `features`, `pairs`, `matches`, `sfm` (with `colmap`, `colmap_database`; `turning`: photos from one
   place are refused; `contradicted`: photos in a wrong place), or `depth_poses` where a sensor measured depth. With
   poses: `pose_fit` (with `epipolar` and `lens_fit`), and where they do not fit `refine_poses`, and `localize` for
   photos that are kept back (both with `mapping`). `depth_poses` and `refine_poses` use `placing` where a sensor
   measured depth. `views`: cameras one by one, and the unit of length.
4. Depth: `sensor_depth`, with `registration`, `depth_scale` and `completion`; or `depth` and `stereo` (its library:
   `patchmatch`), of `neighbors` only, and `planes`; or `mono`. `transients`: what moves before a sensor.
5. `checks`: whether all this fits together; `misfits`: what is said where it does not. `colours`: photos of several
   exposures brought to one.

What a user brings besides: `id_images` and `coco_masks` (masks, ground truth), `hints` (clicks), `given_scene` (a splat
that was trained elsewhere).
"""
