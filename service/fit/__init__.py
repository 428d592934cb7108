"""Registration of measured interaction matrices. Pure numerics: no clock, log, file or thread."""
