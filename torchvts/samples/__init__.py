"""Images of real sensors by others, fetched into a cache on request: none of them is part of the package."""

from .fetch import LARGEST_FILE, SAMPLES, Sample, cache_folder, cached_sample, fetch_sample, read_sample

__all__ = ["LARGEST_FILE", "SAMPLES", "Sample", "cache_folder", "cached_sample", "fetch_sample", "read_sample"]
