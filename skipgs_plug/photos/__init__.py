"""From photographs or a video to a COLMAP folder: gather, reconstruct, undistort, reduce."""
