"""Hosts and regions as network namespaces: a cloud of several machines on one, and faults between them."""
