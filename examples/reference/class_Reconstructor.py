import numpy as np

from pyrcal import rtc

identity = rtc.Identity(
    system="bench", basis_id="kl-1", config_id="mask-1"
)
own = rtc.Reconstructor.own(
    "own-1", np.zeros((20, 72), np.float32), identity, created_ns=0
)
print(own.manifest.id, own.matrix.shape)
