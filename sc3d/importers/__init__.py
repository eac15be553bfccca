"""Projects, clouds and meshes of other programs, read into scenes: one module per program, each with
`matches(path)`, `files(path)` and `read(path, settings)`.
"""
