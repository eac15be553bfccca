"""Every command and the record of its options."""

from __future__ import annotations

from sc3d import settings as options

# stages that are one settings record applied to one scene folder, in the order of the data flow
STAGES: dict[str, type] = {
    "synthesize": options.Synthesize,
    "georeference": options.Georeference,
    "train": options.Train,
    "extract": options.Extract,
    "segment": options.Segment,
    "label": options.Label,
    "propagate": options.Propagate,
    "evaluate": options.Evaluate,
    "export": options.Export,
    "report": options.Report,
}
# commands with arguments of their own
COMMANDS: dict[str, type] = {
    "reconstruct": options.ReconstructCommand, "import": options.ImportCommand, "run": options.Run, "view": options.View, "annotate": options.Annotate,
    "doctor": options.Doctor, "manual": options.Manual, "benchmark": options.Benchmark,
}
MODULES = {"import": "import_project"}  # stage modules that cannot be named like their command
DESCRIPTIONS = {options.Benchmark: "Measure sc3d on this machine."}  # of commands with subcommands: a union of records has no docstring of its own
