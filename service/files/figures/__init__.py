"""The figures of Heritier et al. 2018 for a fit of anybody's data; needs the extra ``plots``."""
