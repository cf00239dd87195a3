"""What runs on a device: precisions, launches, cells, neighbours, states; Warp, its cache and its threads."""
