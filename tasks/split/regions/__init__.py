"""What `segment_rgbd` is made of: `graph_segmentation`, regions that grow over colour, depth and normals."""
