"""Knocked, refocused and otherwise exposed cameras show what their description says, to a fraction of a pixel."""

from dataclasses import replace

import numpy as np
import pytest
from ringdic_node.virtual_rig.bodies import rounded_box, upright_column
from ringdic_node.virtual_rig.disturbance import (
    ShotCondition,
    refocused_camera,
    retracted_camera,
    rolled_camera,
    shifted_camera,
    smeared,
    turned_camera,
)
from ringdic_node.virtual_rig.render import radiance, render
from ringdic_node.virtual_rig.rig import arc_rig
from ringdic_node.virtual_rig.scenes import Bar, Damage, Hair, Shadow, SolidMotion, SolidSpecimen
from ringdic_node.virtual_rig.scenes.damage import HAIR
from ringdic_node.virtual_rig.solid_damage import grown_hairs

CAMERA = arc_rig(4, 30.0, 0.15).cameras[1]
BODY = np.array([[0.0, 0.0, 125.0]])
ROD = SolidSpecimen(upright_column(45.0), seed=4)


@pytest.mark.parametrize("move", [turned_camera, shifted_camera])
@pytest.mark.parametrize("shift", [(3.0, 0.0), (0.0, -1.0), (0.3, 5.0)])
def test_a_knocked_camera_shows_the_body_shifted_by_the_pixels_stated(move, shift) -> None:
    moved = move(CAMERA, *shift)
    seen = (moved.project(BODY) - CAMERA.project(BODY))[0]
    assert seen == pytest.approx(shift, abs=0.03 if move is shifted_camera else 1e-4)  # skew and distortion of the lens
    assert np.allclose(moved.centre, CAMERA.centre) == (move is turned_camera)


def test_a_rolled_camera_turns_its_image_and_a_retracted_one_shrinks_it() -> None:
    axis = CAMERA.R[2]
    on_axis = CAMERA.centre + axis * 330.0
    reach = 330.0 * (CAMERA.height / 3.0) / CAMERA.K[1, 1]
    above = np.array([on_axis, on_axis - reach * CAMERA.R[1]])
    before = CAMERA.project(above)
    rolled = rolled_camera(CAMERA, 2.0).project(above) - before
    assert np.linalg.norm(rolled[0]) < 1e-9
    assert np.linalg.norm(rolled[1]) == pytest.approx(2.0, rel=0.15)  # the lens distorts
    back = retracted_camera(CAMERA, 2.0)
    assert np.allclose(np.cross(axis, back.centre - CAMERA.centre), 0.0)
    depth = float((CAMERA.R @ BODY[0] + CAMERA.t)[2])
    assert float((back.R @ BODY[0] + back.t)[2]) == pytest.approx(depth * (1 + 2.0 / (CAMERA.height / 3.0)))


def test_a_refocused_camera_enlarges_its_image_about_the_principal_point() -> None:
    xyz = BODY + np.random.default_rng(1).uniform(-50.0, 50.0, (20, 3))
    principal = CAMERA.K[:2, 2]
    before, after = CAMERA.project(xyz) - principal, refocused_camera(CAMERA, 1.01).project(xyz) - principal
    np.testing.assert_allclose(after, 1.01 * before, rtol=1e-9)


def test_a_smear_keeps_light_and_place_and_has_the_length_stated() -> None:
    image = np.zeros((41, 61), np.float32)
    image[20, 30] = 1.0
    moved = smeared(image, (6.0, 3.0)).astype(float)
    assert moved.sum() == pytest.approx(1.0, abs=1e-5)
    y, x = np.mgrid[:41, :61]
    assert (moved * x).sum() == pytest.approx(30.0, abs=1e-3)
    assert (moved * y).sum() == pytest.approx(20.0, abs=1e-3)
    spread = (moved * (x - 30.0) ** 2).sum()  # of a line of 6 px: 6²/12, and up to 1/4 of the interpolation
    assert 3.0 <= spread + 0.05 <= 3.3
    assert (moved * (x - 30.0) * (y - 20.0)).sum() == pytest.approx(6.0 * 3.0 / 12.0, abs=0.1)


def test_a_mirrored_image_is_the_image_mirrored_and_light_and_noise_are_factors() -> None:
    plain = render(CAMERA, ROD, 5)
    assert (render(CAMERA, ROD, 5, ShotCondition(mirrored=True)) == plain[:, ::-1]).all()
    assert (render(CAMERA, ROD, 5, ShotCondition(upside_down=True)) == plain[::-1, ::-1]).all()
    half = render(CAMERA, ROD, 5, ShotCondition(light=0.5))
    linear = lambda grey: ((grey / 255.0 + 0.055) / 1.055) ** 2.4  # noqa: E731 - decoding of sRGB
    bright = plain > 100
    assert linear(half[bright].astype(float)).mean() == pytest.approx(0.5 * linear(plain[bright]).mean(), rel=0.01)
    clean = render(CAMERA, ROD, 5, ShotCondition(noise=0.0)).astype(float)
    single, triple = (render(CAMERA, ROD, 5, ShotCondition(noise=n)).astype(float) - clean for n in (1.0, 3.0))
    assert triple[bright].std() == pytest.approx(3.0 * single[bright].std(), rel=0.1)


def test_larger_speckles_are_the_same_pattern_on_a_larger_body() -> None:
    """A rod of three times the size, seen from three times as far by a lens of three times the length, looks alike."""
    middle = BODY[0]
    K = CAMERA.K.copy()
    far = replace(CAMERA, t=-CAMERA.R @ (middle + 3.0 * (CAMERA.centre - middle)), K=K)
    small, large = upright_column(15.0, ends=(-60.0, 60.0)), upright_column(45.0, ends=(-180.0, 180.0))
    first = radiance(CAMERA, SolidSpecimen(small, seed=4))
    second = radiance(far, SolidSpecimen(large, seed=4, speckle=3.0))
    seen = np.zeros(first.shape, bool)
    px = CAMERA.project(middle + np.array([[0.0, 0.0, z] for z in (-40.0, 40.0)]))
    top, bottom = sorted(px[:, 1].astype(int))
    left = int(px[:, 0].mean())
    seen[top:bottom, left - 8 : left + 8] = True
    difference = (first - second)[seen]
    # The light falls off with height in the world; the pattern is the same.
    assert np.corrcoef(first[seen], second[seen])[0, 1] > 0.995
    assert np.abs(difference).max() < 0.2


def test_a_repeating_pattern_comes_again_after_its_period() -> None:
    """A plate shifted by a period in its plane shows the same speckles, and by half a period others."""
    plate = rounded_box((1.5, 150.0, 210.0), 0.5, 30.0)
    window = np.s_[200:290, 150:220]

    def seen(period: float, up: float) -> np.ndarray:
        motion = SolidMotion(shift=(0.0, 0.0, up))
        return radiance(CAMERA, SolidSpecimen(plate, motion, 4, period=period))[window]

    again, between, never = (
        np.corrcoef(seen(period, 0.0).ravel(), seen(period, up).ravel())[0, 1]
        for period, up in ((9.0, 9.0), (9.0, 4.5), (0.0, 9.0))
    )
    assert again > 0.999
    assert abs(between) < 0.5
    assert abs(never) < 0.3


def test_fine_speckles_have_little_contrast_and_the_light_of_others() -> None:
    coarse, fine = (radiance(CAMERA, replace(ROD, speckle=size)) for size in (1.0, 0.33))
    at = CAMERA.project(BODY)[0].astype(int)
    window = np.s_[at[1] - 40 : at[1] + 40, at[0] - 15 : at[0] + 15]
    assert fine[window].mean() == pytest.approx(coarse[window].mean(), rel=0.05)
    assert fine[window].std() < 0.5 * coarse[window].std()


def test_shadows_and_bars_spoil_a_solid_body_where_they_lie() -> None:
    moved = replace(ROD, motion=SolidMotion(shift=(2.0, 0.0, 5.0)))
    clean = radiance(CAMERA, moved)
    xyz, normals, _ = moved.solid.sample(4000)
    seen = moved.visible([CAMERA], xyz, normals)[0]
    at = moved.moved(xyz[seen])
    px = np.rint(CAMERA.project(at)).astype(int)
    shadow = Shadow((0.0, 0.0, 1.0), 125.0, 0.6, 10.0)
    dark = radiance(CAMERA, replace(moved, damage=Damage(shadows=(shadow,))))
    ratio = (dark / clean)[px[:, 1], px[:, 0]]
    np.testing.assert_allclose(ratio[at[:, 2] < 119.0], 0.4, atol=0.01)
    np.testing.assert_allclose(ratio[at[:, 2] > 131.0], 1.0, atol=0.01)
    towards = CAMERA.centre * [1.0, 1.0, 0.0] / np.linalg.norm(CAMERA.centre[:2])
    bar = Bar(tuple(80.0 * towards + [0.0, 0.0, 40.0]), tuple(80.0 * towards + [0.0, 0.0, 200.0]), 4.0)
    barred = radiance(CAMERA, replace(moved, damage=Damage(bars=(bar,))))[px[:, 1], px[:, 0]]
    hidden = Damage(bars=(bar,)).spoilt(CAMERA.centre, at, normals[seen])
    inner = Damage(bars=(replace(bar, radius=3.0),)).spoilt(CAMERA.centre, at, normals[seen])
    outside = ~Damage(bars=(replace(bar, radius=5.0),)).spoilt(CAMERA.centre, at, normals[seen])
    assert 0.03 < hidden.mean() < 0.3
    np.testing.assert_allclose(barred[inner], 0.10, atol=0.01)
    np.testing.assert_allclose(barred[outside], clean[px[:, 1], px[:, 0]][outside], atol=1e-6)


def test_a_mosaic_keeps_the_green_pixels_and_weakens_the_red_and_blue_ones() -> None:
    condition = ShotCondition(noise=0.0, mosaic=True)
    plain, mosaic = (render(CAMERA, ROD, 5, each).astype(float) for each in (ShotCondition(noise=0.0), condition))
    linear = lambda grey: ((grey / 255.0 + 0.055) / 1.055) ** 2.4  # noqa: E731 - decoding of sRGB
    ratio = linear(mosaic) / linear(plain)
    bright = plain > 150
    for row, column, share in ((0, 0, 0.5), (0, 1, 1.0), (1, 0, 1.0), (1, 1, 0.6)):
        place = np.zeros(plain.shape, bool)
        place[row::2, column::2] = True
        assert ratio[place & bright].mean() == pytest.approx(share, abs=0.01)


def test_a_hair_covers_what_its_thickness_and_length_cover_and_moves_with_the_skin() -> None:
    facing = (CAMERA.centre - BODY[0]) * [1.0, 1.0, 0.0]
    facing /= np.linalg.norm(facing)
    root = BODY[0] + 45.0 * facing
    hair = Hair(tuple(root), (0.0, 0.0, 1.0), tuple(np.cross(facing, [0.0, 0.0, 1.0])), 20.0, 0.1)
    for motion in (SolidMotion(), SolidMotion(shift=(4.0, -3.0, 7.0))):
        bare = SolidSpecimen(upright_column(45.0), motion, seed=4)
        plain = radiance(CAMERA, bare).astype(float)
        hairy = radiance(CAMERA, replace(bare, damage=Damage(hairs=(hair,)))).astype(float)
        share = np.divide(plain - hairy, plain - HAIR, out=np.zeros_like(plain), where=np.abs(plain - HAIR) > 1e-3)
        ends = CAMERA.project(bare.moved(root + np.outer([0.0, 20.0], [0.0, 0.0, 1.0])))
        length = np.linalg.norm(ends[1] - ends[0])
        assert share.sum() == pytest.approx(length * 0.2 * length / 20.0, rel=0.1)  # px²
        y, x = np.mgrid[: plain.shape[0], : plain.shape[1]]
        middle = [(share * x).sum() / share.sum(), (share * y).sum() / share.sum()]
        np.testing.assert_allclose(middle, ends.mean(axis=0), atol=0.5)


def test_hairs_grow_all_over_a_body_and_lie_on_it() -> None:
    body = upright_column(45.0)
    hairs = grown_hairs(body, 200, 3)
    assert len(hairs) == 200
    roots, along, across = (np.array([getattr(hair, name) for hair in hairs]) for name in ("root", "along", "across"))
    assert np.abs(body.nearest(roots)[2]).max() < 1e-3
    assert np.abs(np.sum(along * across, axis=1)).max() < 1e-3
    assert np.abs(np.sum(along * body.nearest(roots)[1], axis=1)).max() < 1e-3
    assert np.ptp(roots[:, 2]) > 150.0
