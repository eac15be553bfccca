"""Every command, the record of its options, and the module that runs it."""

from __future__ import annotations

from sc3d.settings import labels, outputs, reconstruction, synthesize, train

# stages that are one settings record applied to one scene folder, in the order of the data flow
STAGES: dict[str, type] = {
    "synthesize": synthesize.Synthesize,
    "georeference": reconstruction.GeoreferenceOptions,
    "depth": reconstruction.Depth,
    "train": train.Train,
    "extract": reconstruction.Extract,
    "segment": labels.Segment,
    "label": labels.Label,
    "propagate": labels.Propagate,
    "evaluate": labels.Evaluate,
    "export": outputs.Export,
    "report": outputs.Report,
}
# commands with arguments of their own
COMMANDS: dict[str, type] = {
    "reconstruct": reconstruction.ReconstructCommand,
    "import": reconstruction.ImportCommand,
    "run": outputs.Run,
    "check": outputs.Check,
    "compare": outputs.Compare,
    "view": outputs.ViewCommand,
    "annotate": labels.Annotate,
    "doctor": outputs.Doctor,
}
MODULES = {  # of the commands that are not in this package
    "reconstruct": "sc3d.stages.reconstruct",
    "import": "sc3d.stages.import_project",
}
