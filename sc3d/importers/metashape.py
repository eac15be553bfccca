"""Agisoft Metashape and PhotoScan: cameras exported as XML (File > Export > Export Cameras > Agisoft XML).

A camera's `transform` is chunk from camera, axes as in COLMAP; the transform of its component (or of the
chunk) is a similarity from there to geocentric coordinates, or to local ones without a CRS. Distortion
(manual, appendix "Camera models"):
    x' = x (1 + k1 r2 + k2 r4 + k3 r6 + k4 r8) + p1 (r2 + 2 x2) + 2 p2 xy    u = w/2 + cx + x' f + x' b1 + y' b2
    y' = y (1 + k1 r2 + k2 r4 + k3 r6 + k4 r8) + p2 (r2 + 2 y2) + 2 p1 xy    v = h/2 + cy + y' f
so p1 and p2 are OpenCV's p2 and p1. A fisheye has the angle from the axis in place of the radius.
p3 and p4 multiply the tangential terms by 1 + p3 r2 + p4 r4. Additional corrections (<corrections>) are added
to u, v: a Fourier series over the photo in pixels, with 48 pairs of coefficients for u and v. What no COLMAP
model has costs pixels, which are compared with a tolerance.

Cameras without a pose of their own are left out: those that were not aligned, and those of a rig but for its
master (`master_id`), as the units of a rig's offsets are not stated.
"""

from __future__ import annotations

import logging
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pycolmap
import pyproj

from sc3d.errors import InputError
from sc3d.geometry.cameras import View
from sc3d.geometry.distortion import DistortionModel, Lenses, NoModelError
from sc3d.georeferencing.alignment import Similarity
from sc3d.georeferencing.georeference import Georeference, crs_to_geodetic, from_origin
from sc3d.importers.frames import enu_of_geocentric, moved_view
from sc3d.importers.project import Project, rigid
from sc3d.settings.reconstruction import Import

logger = logging.getLogger(__name__)

EXPECTED = "an XML file of File > Export > Export Cameras > Agisoft XML is expected"
FISHEYE = ("fisheye", "equidistant_fisheye")
PARAMETERS = {
    "f",
    "fx",
    "fy",
    "cx",
    "cy",
    "skew",
    *(f"{letter}{number}" for letter in "kpb" for number in "1234"),
}
GEOCENTRIC = 1e6  # m: nearer to its center than this nothing is on Earth


class _Builder(ElementTree.TreeBuilder):
    """Refuses document types, and so entities: they can be used to read other files or to fill the memory."""

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise InputError("the XML file has a document type, which no camera export has: it is not read")


def matches(path: Path) -> bool:
    if path.suffix.lower() != ".xml" or not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(1 << 16).replace(b"\0", b"")  # UTF-16, too
    return b"<chunk" in head and b"<sensor" in head


def files(path: Path) -> list[Path]:
    return [path]


def read(path: Path, settings: Import) -> Project:
    chunk = _chunk(path)
    enabled, left_out = _sorted_cameras(chunk)
    transforms = _transforms(chunk, enabled, path)
    cameras, no_model = _cameras(chunk, enabled, path, settings.tolerance)
    kept = []
    for camera in enabled:
        if camera.get("component_id") not in transforms:
            reason = "of other components, which nothing places to the others"
        elif camera.get("sensor_id") not in cameras:
            reason = no_model.get(camera.get("sensor_id"), "without a calibrated sensor")
        else:
            kept.append(camera)
            continue
        left_out.setdefault(reason, []).append(_label(camera))
    poses = [_pose(camera, transforms[camera.get("component_id")], path) for camera in kept]
    views = [
        View(name, cameras[camera.get("sensor_id")], pose)
        for name, camera, pose in zip(_names(chunk, kept), kept, poses)
    ]
    _warn_of_shutter(chunk, kept, path)
    if len(transforms) > 1 and _crs(chunk, path) is None:
        logger.warning(
            "%s: %d components are read as of one frame, but no CRS says that they are: check how they lie to one another",
            path,
            len(transforms),
        )
    moved, georeference = _to_local(views, chunk, path)
    notes: dict[str, object] = {"chunk": chunk.get("label", "")}
    if chunk.find("transform") is None and chunk.find("./components/component/transform") is None:
        notes["scale"] = "arbitrary, as the chunk is not referenced"
    return Project("metashape", moved, georeference=georeference, notes=notes, left_out=left_out)


def _chunk(path: Path) -> ElementTree.Element:
    """The chunk with most cameras that have a pose."""
    try:
        root = ElementTree.parse(path, ElementTree.XMLParser(target=_Builder())).getroot()
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise InputError(f"{path} is not valid XML ({error})") from None
    chunks = [root] if root.tag == "chunk" else list(root.iter("chunk"))
    if not chunks:
        raise InputError(f"{path} has no chunk: {EXPECTED}")
    chunk = max(chunks, key=lambda chunk: len(_sorted_cameras(chunk)[0]))
    if len(chunks) > 1:
        told = [
            f"{other.get('label')!r} ({len(_sorted_cameras(other)[0])} photos)"
            for other in chunks
            if other is not chunk
        ]
        logger.warning(
            "%s has %d chunks: %r, with most placed photos (%d), is read; left out: %s",
            path,
            len(chunks),
            chunk.get("label"),
            len(_sorted_cameras(chunk)[0]),
            ", ".join(told),
        )
    return chunk


def _sorted_cameras(chunk: ElementTree.Element) -> tuple[list[ElementTree.Element], dict[str, list[str]]]:
    """The cameras that are enabled and have a pose, and the labels of all others by reason."""
    placed: list[ElementTree.Element] = []
    left_out: dict[str, list[str]] = {}
    for camera in chunk.iterfind("./cameras//camera"):
        if camera.get("enabled", "true") in ("0", "false"):
            reason = "disabled"
        elif camera.find("transform") is not None:
            placed.append(camera)
            continue
        else:
            reason = (
                "of a rig but for its master, without a pose of their own"
                if camera.get("master_id") not in (None, camera.get("id"))
                else "without a position, as they are not aligned"
            )
        left_out.setdefault(reason, []).append(_label(camera))
    return placed, left_out


def _label(camera: ElementTree.Element) -> str:
    return camera.get("label", "")


def _names(chunk: ElementTree.Element, cameras: list[ElementTree.Element]) -> list[str]:
    """Labels of cameras, behind that of their group where several cameras have the same."""
    groups = {
        camera.get("id"): group.get("label", "")
        for group in chunk.iterfind("./cameras//group")
        for camera in group.iter("camera")
    }
    counts = Counter(map(_label, cameras))
    return [
        f"{groups[camera.get('id')]}/{_label(camera)}"
        if counts[_label(camera)] > 1 and groups.get(camera.get("id"))
        else _label(camera)
        for camera in cameras
    ]


def _cameras(
    chunk: ElementTree.Element, placed: list[ElementTree.Element], path: Path, tolerance: float
) -> tuple[dict[str | None, pycolmap.Camera], dict[str | None, str]]:
    """COLMAP cameras of the sensors that cameras use, by id; and why some are of no kind that COLMAP has,
    unless all are.
    """
    lenses, used = Lenses(tolerance), {camera.get("sensor_id") for camera in placed}
    cameras: dict[str | None, pycolmap.Camera] = {}
    no_model: dict[str | None, NoModelError] = {}
    for sensor in chunk.iterfind("./sensors/sensor"):
        where = f"{path}, sensor {sensor.get('label')!r}"
        if sensor.get("id") not in used:
            continue
        try:
            _check_kind(sensor, where)
            if _calibration(sensor) is not None:
                cameras[sensor.get("id")] = lenses.camera(_distortion_model(sensor, path), where)
        except NoModelError as error:
            no_model[sensor.get("id")] = error
    if no_model and not cameras:
        raise next(iter(no_model.values()))
    lenses.warn(path)
    return cameras, {
        key: f"of a sensor without a COLMAP model ({str(error).removeprefix(f'{path}, ').split(';')[0]})"
        for key, error in no_model.items()
    }


def _warn_of_shutter(chunk: ElementTree.Element, kept: list[ElementTree.Element], path: Path) -> None:
    used = {camera.get("sensor_id") for camera in kept}
    rolling = {
        sensor.get("id")
        for sensor in chunk.iterfind("./sensors/sensor")
        for entry in sensor.iterfind("./property[@name='rolling_shutter']")
        if entry.get("value", "").lower() not in ("", "0", "false", "none", "disabled")
    } & used
    count = sum(camera.get("sensor_id") in rolling for camera in kept)
    if count:
        logger.warning(
            "%s: %d of %d photos have a rolling shutter that Metashape corrects: here each is read as if exposed at once",
            path,
            count,
            len(kept),
        )


def _check_kind(sensor: ElementTree.Element, where: str) -> None:
    calibration = _calibration(sensor)
    kind = (calibration.get("type") if calibration is not None else None) or sensor.get("type", "frame")
    if kind != "frame" and kind not in FISHEYE:
        raise NoModelError(
            f"{where}: {kind} sensors have no COLMAP model; only frame and fisheye (equidistant) have"
        )


def _calibration(sensor: ElementTree.Element) -> ElementTree.Element | None:
    found = sensor.findall("calibration")
    return next(
        (calibration for calibration in found if calibration.get("class") == "adjusted"),
        found[-1] if found else None,
    )


def _distortion_model(sensor: ElementTree.Element, path: Path) -> DistortionModel:
    where, calibration = f"{path}, sensor {sensor.get('label')!r}", _calibration(sensor)
    if calibration is None:
        raise InputError(f"{where} has no calibration")
    kind = calibration.get("type") or sensor.get("type", "frame")
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    try:
        size = {} if resolution is None else resolution.attrib
        width, height = int(size["width"]), int(size["height"])
        values = {child.tag: float(child.text or "") for child in calibration if child.tag in PARAMETERS}
        focal = values["f"] if "f" in values else values["fy"]
    except (ValueError, KeyError):
        raise InputError(f"{where}: its calibration lacks size or focal length") from None
    stretch = values["fx"] - focal if "fx" in values else values.get("b1", 0)
    # PhotoScan 1.0: absolute
    principal = (
        (values.get("cx", 0) + width / 2, values.get("cy", 0) + height / 2)
        if "f" in values
        else (values["cx"], values["cy"])
    )
    return DistortionModel(
        width,
        height,
        (focal + stretch, focal),
        principal,
        tuple(values.get(f"k{n}", 0.0) for n in "1234"),
        (values.get("p2", 0.0), values.get("p1", 0.0)),
        kind in FISHEYE,
        values.get("b2", values.get("skew", 0.0)),
        left_out=(
            *_tangential_cost(values, float(np.hypot(width, height)) / 2 / focal, focal),
            *_corrections_cost(calibration, where),
        ),
    )


def _tangential_cost(values: dict[str, float], reach: float, focal: float) -> tuple[tuple[str, float], ...]:
    """What it costs at most to leave out p3 and p4, px; reach: from the middle to a corner, normalized."""
    size = float(np.hypot(values.get("p1", 0.0), values.get("p2", 0.0))) * 3 * reach**2
    stretch = abs(values.get("p3", 0.0)) * reach**2 + abs(values.get("p4", 0.0)) * reach**4
    return (("p3 and p4", size * stretch * focal),) if stretch else ()


def _corrections_cost(calibration: ElementTree.Element, where: str) -> tuple[tuple[str, float], ...]:
    """What it costs to leave out the additional corrections, px."""
    corrections = calibration.find("corrections")
    words = [] if corrections is None else (corrections.findtext("coeffs") or "").split()
    try:
        pairs = np.array(words, np.float64).reshape(-1, 2)
    except ValueError:
        raise InputError(f"{where}: its additional corrections are no pairs of numbers") from None
    return (("additional corrections", largest_correction(pairs)),) if pairs.any() else ()


def largest_correction(pairs: np.ndarray) -> float:
    """Largest length, px, of a Fourier series over a photo; of an unknown one, the bound.

    pairs: (48, 2) coefficients of u and v, px: rings of frequencies from 1 to 3, of each the cosines and then
        the sines
    """
    if len(pairs) != 48:
        return float(np.hypot(*np.abs(pairs).sum(axis=0)))
    x, y = np.meshgrid(*2 * [np.linspace(-np.pi, np.pi, 64, endpoint=False)])
    waves: list[np.ndarray] = []
    for ring in (1, 2, 3):
        up, down = [(m, ring) for m in range(ring + 1)], [(m, -ring) for m in range(ring - 1, 0, -1)]
        side = [(ring, n) for n in range(ring - 1, -ring - 1, -1)]
        angles = [m * x + n * y for m, n in [*up, *side, *down]]
        waves += [*map(np.cos, angles), *map(np.sin, angles)]
    return float(np.linalg.norm(np.tensordot(pairs.T, np.array(waves), 1), axis=0).max())


def _transforms(
    chunk: ElementTree.Element, cameras: list[ElementTree.Element], path: Path
) -> dict[str | None, Similarity]:
    """Similarity to the world by component id, for all components that share a frame: those with a transform,
    or else the largest one alone.
    """
    ids = [camera.get("component_id") for camera in cameras]
    components = {
        component.get("id"): component.find("transform")
        for component in chunk.iterfind("./components/component")
    }
    own = {
        key: _similarity(transform, path)
        for key in dict.fromkeys(ids)
        if (transform := components.get(key)) is not None
    }
    if own:
        return own
    whole, biggest = chunk.find("transform"), max(dict.fromkeys(ids), key=ids.count, default=None)
    return {biggest: Similarity(1.0, np.eye(3), np.zeros(3)) if whole is None else _similarity(whole, path)}


def _similarity(transform: ElementTree.Element, path: Path) -> Similarity:
    # a 4x4 matrix, as PhotoScan 1.0 writes it
    if transform.find("rotation") is None and transform.text and transform.text.strip():
        matrix = _numbers(transform, 16, path).reshape(4, 4)
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        return Similarity(scale, matrix[:3, :3] / scale, matrix[:3, 3])
    rotation, translation, factor = (transform.find(name) for name in ("rotation", "translation", "scale"))
    return Similarity(
        1.0 if factor is None else float(_numbers(factor, 1, path)[0]),
        np.eye(3) if rotation is None else _numbers(rotation, 9, path).reshape(3, 3),
        np.zeros(3) if translation is None else _numbers(translation, 3, path),
    )


def _pose(camera: ElementTree.Element, world_from_chunk: Similarity, path: Path) -> np.ndarray:
    """(4, 4) cam_from_world."""
    chunk_from_cam = _numbers(camera.find("transform"), 16, path).reshape(4, 4)
    center = world_from_chunk.apply(chunk_from_cam[None, :3, 3])[0]
    return rigid(
        (world_from_chunk.rotation @ chunk_from_cam[:3, :3]).T,
        center,
        f"{path}, camera {camera.get('label')!r}",
    )


def _numbers(element: ElementTree.Element | None, count: int, path: Path) -> np.ndarray:
    if element is None:
        raise InputError(f"{path}: {count} finite numbers are expected and missing")
    try:
        values = np.array((element.text or "").replace(",", " ").split(), np.float64)
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"{path}: {count} finite numbers are expected in <{element.tag}>")
    return values


def _to_local(
    views: list[View], chunk: ElementTree.Element, path: Path
) -> tuple[list[View], Georeference | None]:
    """Views in local ENU and the georeference, if the chunk has a CRS on Earth; unchanged views otherwise."""
    crs = _crs(chunk, path)
    if not views or crs is None or crs.ellipsoid is None:
        return views, None
    middle = np.median([view.center for view in views], axis=0)
    if np.linalg.norm(middle) < GEOCENTRIC:
        logger.warning(
            "%s names a CRS, but its cameras are not in geocentric coordinates: the place stays unknown", path
        )
        return views, None
    axes = crs.ellipsoid.semi_major_metre, crs.ellipsoid.semi_minor_metre
    origin, enu = enu_of_geocentric(middle, lambda points: _geodetic(points, axes, crs.geodetic_crs))
    moved = [moved_view(view, middle, enu) for view in views]
    return moved, from_origin(origin, crs.to_epsg() if crs.is_projected else None)


def _crs(chunk: ElementTree.Element, path: Path) -> pyproj.CRS | None:
    """The chunk's CRS, horizontal part; None if it is local."""
    text = (chunk.findtext("reference") or "").strip()
    if not text or text.startswith(("LOCAL_CS", "LOCAL")):
        return None
    try:
        crs = pyproj.CRS.from_wkt(text)
    except pyproj.exceptions.CRSError:
        raise InputError(f"{path}: its CRS cannot be understood: {text[:80]}") from None
    crs = crs.sub_crs_list[0] if crs.is_compound else crs
    crs = crs.source_crs or crs if crs.is_bound else crs
    epsg = crs.to_epsg()
    return pyproj.CRS.from_epsg(epsg) if epsg else crs


def _geodetic(points: np.ndarray, axes: tuple[float, float], geographic: pyproj.CRS | None) -> np.ndarray:
    """(N, 3) latitude, longitude, height on WGS 84 of geocentric coordinates on the datum of a CRS.

    axes: major and minor of its ellipsoid, m; geographic: the CRS of its datum, None = WGS 84
    """
    cart = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=cart +a={axes[0]!r} +b={axes[1]!r} +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    return crs_to_geodetic(
        np.stack(cart.transform(*points.T), axis=1),
        geographic if geographic is not None and geographic.is_geographic else pyproj.CRS.from_epsg(4326),
    )
