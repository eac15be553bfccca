"""Text prompts of a class table, and the class that a text-prompted detection belongs to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sc3d.errors import InputError
from sc3d.scene.class_table import ClassTable


@dataclass(frozen=True)
class Prompt:
    """A text that a detector looks for, and the class (1 to 255) of what it finds."""

    text: str
    class_id: int


@dataclass(frozen=True)
class Caption:
    """Prompts that a detector reads at once, "building. parking lot.", as T tokens.

    token_ids: T ids, with the tokenizer's start and end tokens and a full stop after each prompt
    spans: first and last token + 1 of each prompt, without its full stop
    prompts: the prompts
    """

    token_ids: list[int]
    spans: list[tuple[int, int]]
    prompts: list[Prompt]


def replace_prompts(class_table: ClassTable, prompts: tuple[str, ...]) -> ClassTable:
    """The table with the prompts of some classes replaced; `prompts`: texts like "road=street,parking lot"."""
    texts = {}
    for prompt in prompts:
        name, separator, values = prompt.partition("=")
        label = class_table.find(name)
        if not separator or label is None or not values.strip():
            raise InputError(
                f"--prompts {prompt!r} must be NAME=text,text with a class name of {[entry.name for entry in class_table]}"
            )
        texts[label] = tuple(value.strip() for value in values.split(",") if value.strip())
    return ClassTable(
        tuple(replace(entry, prompts=texts.get(entry.id, entry.prompts)) for entry in class_table)
    )


def list_prompts(class_table: ClassTable) -> list[Prompt]:
    """Prompts of all classes in lower case; InputError if there are none or one means two classes.

    Full stops and question marks separate prompts in the detector's caption, so they become spaces. A class
    without prompts is not looked for.
    """
    prompts: dict[str, Prompt] = {}
    for entry in class_table:
        for written in entry.prompts:
            text = " ".join(written.lower().replace(".", " ").replace("?", " ").split())
            if not text:
                raise InputError(
                    f"class {entry.name!r} has an empty prompt: remove it, or write what the class looks like in a few words"
                )
            known = prompts.setdefault(text, Prompt(text, entry.id))
            if known.class_id != entry.id:
                raise InputError(
                    f"the prompt {text!r} belongs to the classes {class_table.name(known.class_id)!r} and {entry.name!r}: keep one"
                )
    if not prompts:
        raise InputError(
            'no class has a prompt: add "prompts" to the class table, such as ["building", "house"]'
        )
    return list(prompts.values())


def build_captions(
    tokens: list[tuple[Prompt, list[int]]], start: int, stop: int, end: int, max_tokens: int
) -> list[Caption]:
    """Join prompts to as few captions as a detector's text length allows.

    tokens: prompts with their token ids, without special tokens
    start, stop, end: ids of the tokens that open a caption, follow each prompt, and close a caption
    max_tokens: longest caption that the detector reads, special tokens included
    """
    captions: list[Caption] = []
    for prompt, ids in tokens:
        if len(ids) + 3 > max_tokens:
            raise InputError(
                f"the prompt {prompt.text[:40]!r} is {len(ids)} tokens long, the detector takes {max_tokens - 3}: shorten it"
            )
        if not captions or len(captions[-1].token_ids) + len(ids) + 2 > max_tokens:
            captions.append(Caption([start], [], []))
        caption = captions[-1]
        caption.spans.append((len(caption.token_ids), len(caption.token_ids) + len(ids)))
        caption.prompts.append(prompt)
        caption.token_ids.extend([*ids, stop])
    for caption in captions:
        caption.token_ids.append(end)
    return captions


def match_prompts(
    token_scores: np.ndarray, caption: Caption, box_threshold: float, text_threshold: float
) -> tuple[np.ndarray, np.ndarray]:
    """Prompt and score of each of N boxes, from how well the box matches every token of the caption.

    token_scores: (N, >= T) probability 0 to 1 that the box shows what the token says
    box_threshold, text_threshold: a prompt is a candidate if the box matches one of its tokens better than
        both; tokens that match no better than text_threshold do not count
    returns: (N,) int64 number of the prompt in the caption, -1 for a box without candidate; (N,) float64
        score: the best token of that prompt

    A box may match tokens of several prompts ("building. road."). It goes to the candidate with the highest
    mean over all tokens of the prompt, where tokens that do not count are 0: so "parking lot" with both words
    beats "parking garage" with one. Ties go to the lower class id.
    """
    scores = np.asarray(token_scores, np.float64)
    counted = np.where(scores > text_threshold, scores, 0.0)
    # argmax takes the first of equals
    order = np.argsort([prompt.class_id for prompt in caption.prompts], kind="stable")
    spans = [caption.spans[number] for number in order]
    best = np.stack([scores[:, first:last].max(axis=1) for first, last in spans], axis=1)
    mean = np.stack([counted[:, first:last].mean(axis=1) for first, last in spans], axis=1)
    candidate = (best > box_threshold) & (mean > 0)
    chosen = np.where(candidate, mean, -1.0).argmax(axis=1)
    found = candidate.any(axis=1)
    return np.where(found, order[chosen], -1), np.where(
        found, np.take_along_axis(best, chosen[:, None], axis=1)[:, 0], 0.0
    )
