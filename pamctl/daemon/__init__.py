"""`pamctl daemon`: the rig as a service, and its clients.

A session keeps the loop alive between runs; clients speak JSON-RPC over a socket.
Read `rig_session.py` first, then `session.py` and `server.py`.
"""
