"""Commands on a vehicle without a mount of their own: sync, get, put, ls, scan and others. Layer: top.

Each verb works on `files.Files`: the tree of a connection that it opens itself, or, while a mount of that
vehicle is up, the files of that mount. `verbs` prints, and `progress` draws; the other modules print nothing.
"""
