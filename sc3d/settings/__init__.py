"""Every option of every stage, once: the field is the option, its docstring the help. Imports nothing heavy.

`sc3d STAGE --help`, the sidecar files and the functions all read these records.
"""
