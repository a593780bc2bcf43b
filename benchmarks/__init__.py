"""Measurements that are no part of the product: against its peers, and against its own past."""
