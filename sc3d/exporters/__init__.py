"""The labelled scene for other programs: one module per format, each with `outputs(scene, settings)` and
`write(scene, settings) -> figures`.
"""
