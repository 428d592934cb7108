"""The telescope: sky, pupil, mirror, sensor, and all that is not as it was drawn."""
