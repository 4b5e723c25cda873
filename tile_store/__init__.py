"""Versioned tiles, the inbox of reports, the queue of tiles to merge, and the server that answers tile queries.

`store.Store` says what a store can do, `sqlite_store.SqliteStore` keeps it in one file, `values` go in and out.
"""
