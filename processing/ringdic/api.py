"""The public functions of RingDIC; all of them are names of :mod:`ringdic`.

Two images, without calibration, in five lines::

    import ringdic

    matches = ringdic.correlate("reference.png", "deformed.png")
    matches.displacement
    matches.strain(window=50).field("Exx")
    matches.plot("Exx", window=50)

A session of a calibrated rig, in six::

    import ringdic

    session = ringdic.import_folder("images", "session")
    run = ringdic.process(session, set={"correlation.radius_px": 20})
    run.field("lambda2", step=-1)
    run.plot("lambda2")
    run.export("results.vtkhdf")

Bad input raises :class:`InputError`, valid input that does not determine a result :class:`ComputationError`;
both say in one sentence what is wrong and what to do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask, Pixels
from ringdic.errors import InputError, missing_extra
from ringdic.findings import Finding, Verdict, overall_verdict
from ringdic.progress import Progress, Report, progress_bar, silent

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ringdic.correlation import PointMatches
    from ringdic.jobs.run import Run
    from ringdic.session.folder import Session
    from ringdic.settings import Settings
    from ringdic.strain.image_plane import ImageStrain

ImageSource = str | Path | NDArray
"""An image: the path of a PNG, JPEG, TIFF or PGM file, or an array (height, width) of grey levels."""

ProgressChoice = Callable[[Progress], None] | Literal[False] | None
"""Choice of progress reporting: None shows a bar in a terminal or notebook, False nothing; a function is called."""


@dataclass(frozen=True, repr=False)
class Correlation:
    """Matches of the points of a reference image in a current image: displacement, its gradient, their quality.

    Attributes
    ----------
    xy : (n, 2) px, points of a grid on the reference image; (0, 0) is the centre of the top-left pixel, x to the
        right, y down.
    displacement : (n, 2) px, current minus reference position; NaN where a point was not matched.
    gradient : (n, 2, 2), ∂u_i/∂x_j of the subset, no unit.
    zncc : (n,), zero-normalised cross-correlation, 1 for a perfect match.
    sigma : (n, 2) px, standard deviation of the displacement due to image noise.
    status : (n,), 0 for a match; else why there is none, see :class:`ringdic.correlation.Status`.
    faces : (m, 3) int32, indices of the points of each triangle of the grid.
    seconds : time spent by stage: prepare, start, refine.
    image : (height, width), grey levels of the reference image, over which fields are drawn.
    matches : all results of the correlation at the points, see :class:`ringdic.correlation.PointMatches`.
    findings : what may make the matches wrong, see :class:`ringdic.findings.Finding`.
    """

    matches: PointMatches
    faces: NDArray[np.int32]
    image: NDArray = field(repr=False)
    findings: tuple[Finding, ...] = ()

    def __repr__(self) -> str:
        verdict = f"; {self.verdict}: {self.findings[0].sentence}" if self.findings else ""
        return f"<Correlation: {int(self.good.sum())} of {len(self.xy)} points matched{verdict}>"

    @property
    def verdict(self) -> Verdict:
        """What can be done with the matches, by the worst of the findings; see :class:`ringdic.findings.Verdict`."""
        return overall_verdict(self.findings)

    @property
    def xy(self) -> Pixels:
        """Points of the grid on the reference image, (n, 2) px."""
        return self.matches.xy

    @property
    def displacement(self) -> Pixels:
        """Current minus reference position of each point, (n, 2) px; NaN where it was not matched."""
        return self.matches.uv

    @property
    def gradient(self) -> Floats:
        """Displacement gradient ∂u_i/∂x_j of each point's subset, (n, 2, 2), no unit."""
        return self.matches.gradient

    @property
    def zncc(self) -> Floats:
        """Zero-normalised cross-correlation of each match, (n,), no unit, 1 for a perfect match."""
        return self.matches.zncc

    @property
    def sigma(self) -> Pixels:
        """Standard deviation of each displacement due to image noise, (n, 2) px."""
        return self.matches.sigma

    @property
    def status(self) -> Indices:
        """Status of each point as an int, (n,): 0 for a match, else the reason why there is none."""
        return self.matches.status

    @property
    def good(self) -> Mask:
        """Which points were matched, (n,) bool."""
        return self.matches.good

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds spent by stage: prepare, start, refine."""
        return self.matches.seconds

    def strain(self, window: float = 0.0) -> ImageStrain:
        """Green-Lagrange strain in the plane of the image at every point.

        window : diameter, px, of the circle around a point over whose matches a plane is fitted to the displacements
        by least squares; 0 takes the gradients of the subsets themselves. NaN where a point was not matched or its
        window holds fewer than three matches.
        """
        from ringdic.strain.image_plane import ImageStrain, plane_gradients

        if window == 0:
            return ImageStrain(self.gradient, 0.0)
        return ImageStrain(plane_gradients(self.xy, self.displacement, self.good, window), window)

    def field(self, name: str, window: float = 0.0) -> Floats:
        """A scalar field at every point, (n,).

        name : "u", "v" (px; components of the displacement, to the right and downwards), "magnitude" (px), "zncc", or
        a strain "Exx", "Eyy", "Exy", "E1", "E2" (no unit). window : of the strain, px, see :meth:`strain`.
        Raises InputError for another name.
        """
        plain: dict[str, Callable[[], Floats]] = {
            "u": lambda: self.displacement[:, 0],
            "v": lambda: self.displacement[:, 1],
            "magnitude": lambda: np.hypot(self.displacement[:, 0], self.displacement[:, 1]),
            "zncc": lambda: self.zncc,
        }
        if name in plain:
            return plain[name]()
        if name not in _IMAGE_FIELDS:
            raise InputError(f"no field '{name}'; there are {', '.join(_IMAGE_FIELDS)}")
        return self.strain(window).field(name)

    def plot(
        self,
        name: str = "magnitude",
        *,
        window: float = 0.0,
        limits: tuple[float, float] | None = None,
        axes: Axes | None = None,
    ) -> Axes:
        """Draw a field over the reference image into matplotlib axes, which are returned.

        Parameters
        ----------
        name : the field, see :meth:`field`.
        window : of the strain, px, see :meth:`strain`.
        limits : of the colours, in the field's unit; all values but the outermost percent unless given.
        axes : where to draw; a new figure unless given.
        """
        from ringdic.pictures.axes import draw_over_image
        from ringdic.pictures.scale import Scale
        from ringdic.results.fields import Field
        from ringdic.results.ranges import even_limits

        values = self.field(name, window)
        label, unit, centre = _IMAGE_FIELDS[name]
        if limits is None:
            known = values[np.isfinite(values)]
            limits = even_limits(np.percentile(known, (0.5, 99.5)).tolist() if len(known) else None, centre)
        scale = Scale(Field(name, label, unit, "point", centre), *limits)
        return draw_over_image(axes, self.image, self.xy, self.faces, values, scale)

    def save(self, path: str | Path) -> Path:
        """Write the matches to an npz file, and return its path.

        The arrays are those that ``ringdic correlate`` writes: xy, uv (the displacement), gradient, zncc, iterations,
        status, sigma and faces.
        Raises InputError where nothing can be written to the path.
        """
        from ringdic.correlation.command import write_points

        path = Path(path)
        if path.is_dir() or not path.resolve().parent.is_dir():
            raise InputError(f"{path}: not a file in a folder that exists; give the name of a file, such as points.npz")
        write_points(path, self.matches, self.faces)
        return path


#: Label, unit and, for a diverging scale of colours, middle of the fields of an image pair.
_IMAGE_FIELDS: dict[str, tuple[str, str, float | None]] = {
    "u": ("Displacement u, to the right", "px", 0.0),
    "v": ("Displacement v, downwards", "px", 0.0),
    "magnitude": ("Displacement", "px", None),
    "zncc": ("ZNCC (1 best)", "", None),
    "Exx": ("Green-Lagrange Exx", "", 0.0),
    "Eyy": ("Green-Lagrange Eyy", "", 0.0),
    "Exy": ("Green-Lagrange Exy", "", 0.0),
    "E1": ("Green-Lagrange E1, smaller principal", "", 0.0),
    "E2": ("Green-Lagrange E2, larger principal", "", 0.0),
}


def correlate(
    reference: ImageSource,
    current: ImageSource,
    *,
    mask: str | Path | Mask | None = None,
    radius: int = 20,
    step: int = 10,
    order: int = 1,
    subset: Literal["circle", "square"] = "circle",
    interpolation: Literal["quintic", "cubic"] = "quintic",
    threads: int | None = None,
    accept: Sequence[str] = (),
    progress: ProgressChoice = None,
) -> Correlation:
    """Digital image correlation of two images: where each point of the reference lies in the current image.

    Parameters
    ----------
    reference, current : paths of image files, or (height, width) arrays of grey levels; of one size.
    mask : region of interest on the reference, as an image file that is not black inside or a (height, width) array
        of bool; the whole image unless given.
    radius : of the subset, px.
    step : spacing of the points, px.
    order : of the shape function: 1 affine, 2 quadratic.
    subset : "circle" or "square".
    interpolation : B-spline of the current image, "quintic" or "cubic".
    threads : processor cores to use; all unless given.
    accept : codes of findings that do not forbid to use the matches; with "repeating-pattern" those of a pattern that
        repeats itself are kept, which are lost otherwise.
    progress : None shows a bar, False nothing; a function is called with each :class:`ringdic.progress.Progress`.

    Raises
    ------
    InputError : an unreadable image, images of different size, a mask without points, a setting out of range.
    ComputationError : no point of the reference was matched in the current image.

    Examples
    --------
    A speckle pattern that is shifted by 1.5 px to the right:

    >>> import numpy as np
    >>> from scipy.ndimage import gaussian_filter, shift
    >>> speckle = gaussian_filter(np.random.default_rng(0).random((100, 100)), 1.5)
    >>> matches = ringdic.correlate(speckle, shift(speckle, (0.0, 1.5)), radius=10, progress=False)
    >>> matches.displacement[matches.good].mean(axis=0).round(2) + 0.0
    array([1.5, 0. ])
    >>> strain = matches.strain(window=40).field("Exx")
    >>> bool(abs(np.nanmedian(strain)) < 0.001)
    True
    """
    with _reported(progress) as report:
        report(Progress("prepare", 0.0, "loading the kernels"))
        from ringdic.correlation.command import correlate_images
        from ringdic.correlation.settings import CorrelationSettings
        from ringdic.correlation.warming import compiling_reported

        settings = CorrelationSettings(
            radius=radius, step=step, order=order, subset=subset, interpolation=interpolation
        )
        images = _image(reference, "the reference image"), _image(current, "the current image")
        region = None if mask is None else _region(mask, images[0])
        names = _name(reference, "the reference image"), _name(current, "the current image"), _name(mask, "the mask")
        with compiling_reported(report) as report:
            matches, faces, findings = correlate_images(
                *images, region, settings, threads=threads, names=names, accept=accept,
                progress=lambda done, total: report(Progress("correlate", done / total, f"{done} of {total} points")),
            )  # fmt: skip
    marked = tuple(replace(finding, accepted=finding.code in accept) for finding in findings)
    return Correlation(matches, faces, images[0], marked)


def import_folder(source: str | Path, session: str | Path) -> Session:
    """Create a session folder from a folder of images, after checking every image.

    source : a folder with ``rig.toml`` and the folders ``board``, ``target`` and ``specimen``, each with the images of
    every camera. session : the folder to create; it must not exist yet.

    Raises InputError for a missing or damaged image, an unknown key in ``rig.toml``, or a session that exists.
    """
    from ringdic.session.folder import open_session
    from ringdic.session.importing import import_images

    import_images(Path(source), Path(session))
    return open_session(Path(session))


def process(
    session: Session | str | Path,
    settings: Settings | str | Path | None = None,
    *,
    set: Sequence[str] | Mapping[str, Any] = (),
    progress: ProgressChoice = None,
    cluster: str | None = None,
    accept: Sequence[str] = (),
) -> Run:
    """Process a session: calibrate the cameras, correlate, triangulate, and compute deformation at every step.

    Parameters
    ----------
    session : a session or its folder.
    settings : the settings, or the path of a TOML file with some of them; the defaults unless given.
    set : single settings that change these, as a mapping {"correlation.radius_px": 14} or as texts
        "correlation.radius_px=14".
    progress : None shows a bar, False nothing; a function is called with each :class:`ringdic.progress.Progress`.
    cluster : address of a dask scheduler whose workers see the session folder under the same path; this computer
        alone unless given.
    accept : codes of findings that do not forbid to use the results, such as "camera-moved-unknown"; they are stored
        with the results as the setting of this name.

    Returns
    -------
    The new run, whose `Run.verdict` says whether its results can be used; earlier runs of the session stay as they
    are. What an interrupted run has matched is not matched again.

    Raises
    ------
    InputError : a damaged session, an unknown setting, too few images.
    ComputationError : the cameras cannot be calibrated, or no camera pair gives a surface.

    Examples
    --------
    >>> run = ringdic.process(session, set={"correlation.step_px": 12}, progress=False)
    >>> run.steps
    ('0006-specimen', '0007-specimen', '0008-specimen')
    """
    chosen = _settings(settings, set)
    if accept:
        chosen = _settings(chosen, {"accept": [*chosen.accept, *accept]})
    path = Path(session) if isinstance(session, str | Path) else session.path
    with _reported(progress) as report:
        report(Progress("prepare", 0.0, "loading the kernels"))
        from ringdic.correlation.warming import compiling_reported
        from ringdic.jobs.pipeline import process_session  # takes a while: the settings are checked first
        from ringdic.session.folder import open_session

        executor = None
        if cluster is not None:
            from ringdic.jobs.cluster import ClusterExecutor

            executor = ClusterExecutor(cluster)
            path = open_session(path.resolve()).path  # the workers' working folders are others
            report(Progress("prepare", 0.0, f"asking the workers of {cluster}"))
            executor.check(path)
        with compiling_reported(report) as report:
            folder = process_session(path, chosen, report, executor)
    return read_run(path, int(folder.name))


def read_run(session: Session | str | Path, number: int | None = None) -> Run:
    """Open a finished processing run of a session.

    session : a session or its folder. number : of the run, from 1; the newest unless given.
    Raises InputError where the session has not been processed, or has no run of this number.

    >>> ringdic.read_run(session).number
    1
    """
    from ringdic.jobs.run import Run
    from ringdic.session.folder import newest_results, open_session

    opened = open_session(Path(session)) if isinstance(session, str | Path) else session
    return Run(opened, newest_results(opened.path, number).parent)


@contextmanager
def _reported(progress: ProgressChoice) -> Iterator[Report]:
    """Context that yields the progress function; a package missing inside raises InputError, naming its extra."""
    try:
        if progress is None:
            with progress_bar() as report:
                yield report
        else:
            yield progress or silent
    except ModuleNotFoundError as error:
        raise missing_extra(error) or error from error


def _settings(settings: Settings | str | Path | None, changes: Sequence[str] | Mapping[str, Any]) -> Settings:
    """Settings with some of them changed."""
    from ringdic.settings import Settings, load_settings

    if isinstance(changes, Mapping):
        changes = [_assignment(name, value) for name, value in changes.items()]
    elif isinstance(changes, str):
        changes = [changes]
    if isinstance(settings, Settings):
        above = [_assignment(name, getattr(settings, name)) for name in ("method", "accept")]
        groups = settings.model_dump(exclude={"method", "accept"}).items()
        own = [_assignment(f"{group}.{name}", value) for group, values in groups for name, value in values.items()]
        if settings.calibration.method == Settings(method=settings.method).calibration.method:
            own.remove(_assignment("calibration.method", settings.calibration.method))  # it follows the method
        return load_settings(None, [*above, *own, *changes])
    return load_settings(None if settings is None else Path(settings), list(changes))


def _assignment(name: str, value: Any) -> str:
    """A setting as ``name=value``, where truth and lists are written as in TOML."""
    if isinstance(value, list | tuple):
        return f"{name}={[str(each) for each in value]}"
    return f"{name}={str(value).lower() if isinstance(value, bool) else value}"


def _image(source: ImageSource, name: str) -> NDArray:
    """Grey levels (height, width) of a file or an array; numbers that are not 8 or 16 bits are scaled to 0 … 255."""
    if isinstance(source, str | Path):
        from ringdic.session.images import read_gray

        return read_gray(Path(source))
    image = np.asarray(source)
    if image.ndim != 2 or not image.size or not np.issubdtype(image.dtype, np.number):
        raise InputError(f"{name} is an array {image.shape} of {image.dtype}; give numbers (height, width)")
    if image.dtype in (np.uint8, np.uint16):
        return image
    levels = image.astype(np.float64)
    if not np.isfinite(levels).all():
        raise InputError(f"{name} has grey levels that are not finite; fill them")
    low, high = levels.min(), levels.max()
    return (levels - low) * (255.0 / max(high - low, 1e-300))


def _region(mask: str | Path | Mask, image: NDArray) -> Mask:
    """The region of interest (height, width) bool of a file or an array, of the size of the image (height, width)."""
    if isinstance(mask, str | Path):
        from ringdic.session.images import read_mask

        return read_mask(Path(mask), (image.shape[0], image.shape[1]))
    region = np.asarray(mask) != 0
    if region.shape != image.shape or not region.any():
        raise InputError(f"the mask is an array {region.shape}; give {image.shape} with the region of interest marked")
    return region


def _name(source: ImageSource | None, name: str) -> str:
    return str(source) if isinstance(source, str | Path) else name
