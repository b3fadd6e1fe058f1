"""Who there is, and who may do what: changed by the command line for all realms, over HTTP for one's own (SPEC 1.16).

``change`` does each change with its entry in the audit log; ``own`` is that for an administrator of a realm; ``people``
and ``machines`` are what he sees and does, ``desk`` is whom he asks.
"""
