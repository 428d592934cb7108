"""The archive: immutable HDF5 files, an SQLite index and audit trail.

::

    <directory>/
      reconstructors/<id>.h5        one reconstructor each, written once, complete or absent
      interaction_matrices/<id>.h5  one measured interaction matrix each, likewise
      noisy_matrices/<id>.h5        one noisy interaction matrix each, likewise
      recordings/<id>.h5            requested telemetry, readable while it grows
      tracking.json                 the registration, for the service after this one
      index.sqlite                  state of each product, audit trail, and α over time
      lock                          held while a service uses the directory
"""

from service.archive.archive import Archive
from service.archive.index import Actor, AuditEntry, Channel, Pin, Range
from service.archive.nights import Mark, Night

__all__ = ["Actor", "Archive", "AuditEntry", "Channel", "Mark", "Night", "Pin", "Range"]
