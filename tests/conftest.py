"""Float64, compiler flags, one CPU device per core and the compilation cache for every test."""

from studies.config import configure

configure()
