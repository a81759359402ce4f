"""Traces of texel fetches: the type, its files, layouts, checks and analysis."""

from traces.compiled_code import use_cache_of_sources

use_cache_of_sources()
