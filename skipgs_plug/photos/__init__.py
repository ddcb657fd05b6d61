"""Turn photographs or a video into a COLMAP folder: gather, reconstruct, undistort, and write reduced copies."""
