"""The Shack-Hartmann: a spot under each lenslet, its centroid on pixels."""
