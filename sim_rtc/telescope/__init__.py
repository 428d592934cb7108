"""The telescope: sky, pupil, mirror, sensor, imperfections."""
