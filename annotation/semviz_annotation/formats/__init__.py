"""Labels in other people's formats: CVAT for images 1.1, labelme, COCO keypoints."""
