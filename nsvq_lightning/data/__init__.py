"""From a COLMAP folder to views: model files, cameras, images, the order of views, Lightning data modules."""
