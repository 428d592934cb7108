"""Commands on what a service keeps: its archive, bundles for other machines, certificates."""
