"""Start values between cameras without a calibration: matched image features and local affine maps through them.

Scale-invariant features (Lowe 2004) can be matched over displacements of any size and foreshortening up to about 40°;
the propagation reaches the points beyond.
"""

from __future__ import annotations

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ringdic.arrays import Floats, Pixels
from ringdic.correlation.prepared import Current, Reference, as_8_bit

_PIXELS = 0.45e6  # larger images are reduced to this; the detector doubles them again
_FEATURES = 2500  # per image at most
_RATIO = 0.85  # largest ratio of the distances to the best and to the second best descriptor
_NEAREST = 14  # features around a point that its affine map is fitted to
_TRIALS = 120  # random triples of features
_TOLERANCE = 3.0  # px of the full image by which a match may deviate from its local affine map


def feature_start_values(reference: Reference, current: Current, xy: Pixels, radius: int) -> Floats:
    """Start values from the affine map through the matched features around each point.

    xy : (n, 2) float64, px, points of the reference image. radius : px, of the subset.
    Returns (n, 12), displacement in px and its gradients in the order of the kernels' parameters; NaN where too few
    features agree.
    """
    p, q = matched_features(reference, current)
    out = np.full((len(xy), 12), np.nan)
    if len(p) < 2 * _NEAREST:
        return out
    distance, near = scipy.spatial.cKDTree(p).query(xy, k=_NEAREST)
    for k in range(len(xy)):
        around = near[k][distance[k] < 8 * radius]
        if len(around) >= 5:
            out[k] = _local_affine(p[around] - xy[k], q[around] - p[around])
    return out


def matched_features(reference: Reference, current: Current) -> tuple[Pixels, Pixels]:
    """Positions of features in two images, each the best match of the other.

    The reference's features lie inside its mask. Returns two arrays (k, 2), px, positions in the reference and in the
    current image.
    """
    scale = min(1.0, np.sqrt(_PIXELS / max(reference.image.size, current.image.size)))
    x0, y0 = reference.origin.astype(int)
    h, w = reference.mask.shape
    ref, mask = reference.image[y0 : y0 + h, x0 : x0 + w], reference.mask.astype(np.uint8) * 255
    points_r, descriptors_r = _features(ref, mask, scale)
    points_c, descriptors_c = _features(current.image, None, scale)
    if len(points_r) < 3 or len(points_c) < 3:
        return np.empty((0, 2)), np.empty((0, 2))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    forward = matcher.knnMatch(descriptors_r, descriptors_c, k=2)
    pairs = [(m[0].queryIdx, m[0].trainIdx, m[0].distance) for m in forward if m[0].distance < _RATIO * m[1].distance]
    best: dict[int, tuple[int, float]] = {}
    for query, train, distance in pairs:  # at most one reference feature for each current one
        if train not in best or distance < best[train][1]:
            best[train] = (query, distance)
    rows = np.array([(query, train) for train, (query, _) in best.items()], dtype=np.int64).reshape(-1, 2)
    return points_r[rows[:, 0]] + (x0, y0), points_c[rows[:, 1]]


def _features(image: NDArray, mask: NDArray | None, scale: float) -> tuple[Pixels, NDArray[np.float32]]:
    """Positions (k, 2) of features, px of the given image, and their descriptors (k, 128).

    mask : where to look, or None for everywhere. scale : to which the image is reduced first.
    """
    grey: NDArray = as_8_bit(image)
    if scale < 1.0:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        if mask is not None:
            mask = cv2.resize(mask, (grey.shape[1], grey.shape[0]), interpolation=cv2.INTER_NEAREST)
    features, descriptors = cv2.SIFT.create(nfeatures=_FEATURES).detectAndCompute(grey, mask)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    at = np.array([feature.pt for feature in features], dtype=np.float64)
    # One place can have several features of different orientation; that weakens the ratio test only a little.
    return (at + 0.5) / scale - 0.5, np.asarray(descriptors, dtype=np.float32)


def _local_affine(d: Pixels, uv: Pixels) -> Floats:
    """Affine map that most of the feature matches around a point agree on, as parameters (12,) at the point.

    d : (k, 2) px, reference positions of the features from the point. uv : (k, 2) px, their displacements. The map with
    the most votes among those through random triples is refined by least squares. NaN if fewer than five matches agree
    with it.
    """
    out = np.full(12, np.nan)
    k = len(d)
    draws = np.random.default_rng(0).random((_TRIALS, k)).argsort(axis=1)[:, :3]
    A = np.concatenate([np.ones((k, 1)), d], axis=1)
    area = np.abs(np.linalg.det(A[draws]))
    draws = draws[area > 1e-3 * max(area.max(), 1e-12)]
    if not len(draws):
        return out
    fits = np.linalg.solve(A[draws], uv[draws])
    residual = np.linalg.norm(A @ fits - uv, axis=2)
    votes = (residual < _TOLERANCE).sum(axis=1)
    inliers = residual[np.argmax(votes)] < _TOLERANCE
    if inliers.sum() < 5:
        return out
    fit = np.linalg.lstsq(A[inliers], uv[inliers], rcond=None)[0]
    out[:] = 0.0
    out[0:3], out[6:9] = fit[:, 0], fit[:, 1]
    return out
