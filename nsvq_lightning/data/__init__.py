"""From a COLMAP folder to views: model files, cameras, images, the order of views, Lightning data modules."""

NO_FOLDER = "scene folder {} does not exist: give the folder that holds images/ and sparse/"
