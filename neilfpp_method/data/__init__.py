"""Read captures: views, split, scene box, point cloud, pixels and ground truth."""
