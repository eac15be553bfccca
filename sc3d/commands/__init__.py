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
MODULES = {  # of the commands that are not in this package
    "reconstruct": "sc3d.stages.reconstruct", "import": "sc3d.stages.import_project", "manual": "tools.manual_stage", "benchmark": "tools.benchmark.__main__",
}
DESCRIPTIONS = {options.Benchmark: "Measure sc3d on this machine."}  # of commands with subcommands: a union of records has no docstring of its own
