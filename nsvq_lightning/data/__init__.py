"""From a COLMAP folder to views: model files, cameras, images, the order of views, Lightning data modules."""

NO_FOLDER = "scene folder {} does not exist, or is a file: give the folder that holds images/ and sparse/"
PANORAMA = "cut the panoramas into pictures of a common lens first, as COLMAP's example panorama_sfm.py does"
