from pyrcal import rtc

identity = rtc.Identity(
    system="bench", basis_id="kl-2026-03", config_id="mask-2026-03"
)
print(identity.system, identity.reference_id)
