"""Transforms of splats, which look the same to a camera that moves with them; and places on the Earth."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.cameras.camera import Camera, look_at
from sparklod_cli.images.metrics import psnr
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.model.transforms import (
    FLATTENING,
    LARGEST,
    RADIUS,
    ROWS,
    Transform,
    earth_matrix,
    place_of,
    sh_basis,
    sh_rotations,
)
from sparklod_cli.render.rasterizer import Image, draw, shade
from sparklod_cli.render.render_settings import RasterSettings
from tests.references.gaussians import covariance as reference_covariance
from tests.references.gaussians import rotation_matrix
from tests.references.spark_pictures import spherical_harmonics
from tests.scenes import random_splats

#: Least PSNR of pictures that float32 alone makes differ, in dB; those of SH that are not turned are far below it.
SAME, OTHER = 60.0, 40.0

angles = st.floats(-720, 720)
quats = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda quat: math.hypot(*quat) > 1e-3)
moves = st.tuples(*[st.floats(-50, 50)] * 3)
scales = st.floats(-3, 3).map(math.exp)


@st.composite
def transforms(draw_from: st.DrawFn) -> Transform:
    rotation = Transform.from_quat(draw_from(quats)).rotation
    return Transform(rotation, draw_from(scales), np.array(draw_from(moves)))


def columns_of(splats: Splats) -> dict[str, np.ndarray]:
    return {name: getattr(splats, name) for name in COLUMNS}


def assert_near(found: Splats, expected: Splats, most: float) -> None:
    """Equal but for rounding, where a quaternion and its negative are the same rotation."""
    for name, column in columns_of(expected).items():
        other = getattr(found, name)
        if name == "quat_xyzw":
            other = other * np.sign(np.einsum("ij,ij->i", other, column))[:, None]
        np.testing.assert_allclose(other, column, rtol=most, atol=most * max(1, np.abs(column).max(initial=0)))


def colors(splats: Splats, directions: np.ndarray) -> np.ndarray:
    """(N, 3) of each splat from one direction, by the reference's own harmonics."""
    basis = [spherical_harmonics(direction, splats.sh_degree) for direction in directions]
    return np.einsum("nk,nkc->nc", np.array(basis), splats.sh.astype(np.float64))


# Spherical harmonics


@given(st.integers(0, 2**32 - 1), st.integers(1, 3))
def test_the_basis_is_that_of_the_reference(seed: int, degree: int) -> None:
    direction = np.random.default_rng(seed).normal(size=3)
    direction /= np.linalg.norm(direction)
    np.testing.assert_allclose(sh_basis(direction[None], degree)[0], spherical_harmonics(direction, degree), atol=1e-12)


@given(quats, st.integers(0, 3))
def test_rotations_of_harmonics_are_orthogonal_and_exact(quat: tuple[float, ...], degree: int) -> None:
    rotation = Transform.from_quat(quat).rotation
    found = sh_rotations(rotation, degree)
    assert [turn.shape for turn in found] == [(2 * at + 1, 2 * at + 1) for at in range(1, degree + 1)]
    directions = np.random.default_rng(1).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before, after = sh_basis(directions, degree), sh_basis(directions @ rotation.T, degree)
    start = 0
    for turn in found:
        np.testing.assert_allclose(turn @ turn.T, np.eye(len(turn)), atol=1e-12)
        part = slice(start, start + len(turn))
        np.testing.assert_allclose(after[:, part], before[:, part] @ turn.T, atol=1e-12)
        start = part.stop


@given(transforms(), st.integers(1, 3))
def test_a_turned_splat_has_its_colour_in_the_turned_direction(transform: Transform, degree: int) -> None:
    splats = random_splats(40, sh_degree=degree)
    directions = np.random.default_rng(2).normal(size=(len(splats), 3))
    np.testing.assert_allclose(
        colors(transform.apply(splats), directions @ transform.rotation.T), colors(splats, directions), atol=2e-6
    )


def test_half_turns_twice_give_the_same_bits() -> None:
    splats = random_splats(500, sh_degree=3)
    splats.sh[:, ::2] *= np.float32(1e-12)  # which the rounding errors of its large neighbours would change
    for turn in (Transform.from_euler(180, 0, 0), Transform.from_euler(0, 180, 0), Transform.from_euler(0, 0, -180)):
        once = turn.apply(splats)
        assert not np.array_equal(once.sh, splats.sh)
        twice = turn.apply(once)
        np.testing.assert_array_equal(twice.center, splats.center)
        np.testing.assert_array_equal(twice.sh, splats.sh)
        np.testing.assert_array_equal(np.abs(twice.quat_xyzw), np.abs(splats.quat_xyzw))


# Centres, axes and sizes


@given(transforms(), st.integers(0, 100))
def test_centres_and_covariances_follow_the_matrix(transform: Transform, seed: int) -> None:
    splats = random_splats(30, seed=seed)
    moved = transform.apply(splats)
    expected = np.c_[splats.center, np.ones(30)] @ transform.matrix[:3].T
    np.testing.assert_allclose(moved.center, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    axes = transform.matrix[:3, :3]
    before = reference_covariance(splats.scale, splats.quat_xyzw)
    after = reference_covariance(moved.scale, moved.quat_xyzw)
    np.testing.assert_allclose(after, axes @ before @ axes.T, atol=1e-5 * np.abs(after).max())
    np.testing.assert_allclose(np.linalg.norm(moved.quat_xyzw.astype(np.float64), axis=1), 1, atol=3e-7)
    np.testing.assert_array_equal(moved.rgb, splats.rgb)
    np.testing.assert_array_equal(moved.opacity, splats.opacity)


def test_scales_and_moves_touch_nothing_else() -> None:
    splats = random_splats(20, sh_degree=2)
    doubled = Transform(scale=2).apply(splats)
    moved = Transform(translation=np.array([1, 2, 4])).apply(splats)
    np.testing.assert_array_equal(doubled.center, 2 * splats.center)
    np.testing.assert_array_equal(doubled.scale, 2 * splats.scale)
    np.testing.assert_array_equal(moved.center, (splats.center + np.array([1.0, 2, 4])).astype(np.float32))
    assert moved.scale is splats.scale
    for one in (doubled, moved):
        assert one.quat_xyzw is splats.quat_xyzw
        assert one.sh is splats.sh


def test_the_identity_returns_what_it_was_given() -> None:
    splats = random_splats(5, sh_degree=3)
    for identity in (Transform(), Transform.from_parts(), Transform.from_euler(360, -720, 0), Transform.from_up("y")):
        assert identity.is_identity
        assert identity.apply(splats) is splats


def test_no_splats_and_more_than_one_block() -> None:
    transform = Transform.from_parts(rotate=(10, 20, 30), scale=0.5, translate=(1, 2, 3))
    assert len(transform.apply(random_splats(0, sh_degree=3))) == 0
    splats = random_splats(2 * ROWS + 7, sh_degree=3)
    whole = transform.apply(splats)
    for at in (0, ROWS - 1, ROWS, 2 * ROWS, 2 * ROWS + 6):
        alone = transform.apply(splats.take(slice(at, at + 1)))
        assert_near(whole.take(slice(at, at + 1)), alone, 1e-7)


def test_invalid_splats_stay_invalid_and_others_are_unharmed() -> None:
    splats = random_splats(5, sh_degree=3)
    splats.center[0, 1] = np.inf
    splats.sh[1, 4] = np.nan
    splats.quat_xyzw[2] *= 2
    splats.scale[3, 0] *= -1
    moved = Transform.from_parts(rotate=(10, 20, 30), scale=3, translate=(1, 2, 3)).apply(splats)
    np.testing.assert_array_equal(moved.is_valid(), [False, False, False, False, True])
    far = random_splats(2)
    far.center[0] = 1e30  # it leaves the range of float32
    assert Transform(scale=1e11).apply(far).is_valid().tolist() == [False, True]


# Composition


@given(transforms(), transforms())
def test_two_transforms_one_after_another_are_one(first: Transform, second: Transform) -> None:
    splats = random_splats(20, sh_degree=3)
    assert_near(first.then(second).apply(splats), second.apply(first.apply(splats)), 1e-5)
    np.testing.assert_allclose(
        first.then(second).matrix, second.matrix @ first.matrix, rtol=1e-9, atol=1e-9 * LARGEST**0.5
    )


@given(transforms())
def test_the_inverse_undoes(transform: Transform) -> None:
    splats = random_splats(20, sh_degree=3)
    np.testing.assert_allclose(transform.then(transform.inverse()).matrix, np.eye(4), atol=1e-9)
    back = transform.inverse().apply(transform.apply(splats))
    offset = float(np.abs(transform.translation).max() / transform.scale)  # float32 loses what a move is larger by
    assert_near(back, splats, 2e-6 * (1 + offset))


# What the numbers mean


@given(angles, angles, angles)
def test_euler_angles_are_those_of_splat_transform(x: float, y: float, z: float) -> None:
    """The quaternion of PlayCanvas's `setFromEulerAngles`, by the product of its half angles."""
    (sx, cx), (sy, cy), (sz, cz) = ((math.sin(a), math.cos(a)) for a in np.radians([x, y, z]) / 2)
    quat = [
        sx * cy * cz - cx * sy * sz,
        cx * sy * cz + sx * cy * sz,
        cx * cy * sz - sx * sy * cz,
        cx * cy * cz + sx * sy * sz,
    ]
    np.testing.assert_allclose(
        Transform.from_euler(x, y, z).rotation, Transform.from_quat(quat).rotation, rtol=0, atol=1e-12
    )


@given(quats, st.floats(1e-200, 1e200))
def test_a_quaternion_of_any_length_is_its_rotation(quat: tuple[float, ...], length: float) -> None:
    expected = rotation_matrix(np.array(quat) / math.hypot(*quat))
    np.testing.assert_allclose(Transform.from_quat(np.array(quat) * length).rotation, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("axis", "up", "forward"),
    [
        ("y", (0, 1, 0), (0, 0, -1)),
        ("-y", (0, -1, 0), (0, 0, 1)),
        ("z", (0, 0, 1), (0, 1, 0)),
        ("-z", (0, 0, -1), (0, -1, 0)),
    ],
)
def test_what_is_up_becomes_y_and_right_stays_right(
    axis: str, up: tuple[int, int, int], forward: tuple[int, int, int]
) -> None:
    rotation = Transform.from_up(axis).rotation
    np.testing.assert_array_equal(rotation @ up, [0, 1, 0])
    np.testing.assert_array_equal(rotation @ [1, 0, 0], [1, 0, 0])
    np.testing.assert_array_equal(rotation @ forward, [0, 0, -1])


def test_parts_come_one_after_another() -> None:
    whole = Transform.from_parts(up="z", rotate=(10, 20, 30), scale=3, translate=(1, 2, 4))
    steps = (
        Transform.from_up("z")
        .then(Transform.from_euler(10, 20, 30))
        .then(Transform(scale=3))
        .then(Transform(translation=np.array([1, 2, 4])))
    )
    np.testing.assert_allclose(whole.matrix, steps.matrix, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Transform.from_up("x"), "'x' is not an axis that can point up; use one of y, -y, z, -z"),
        (lambda: Transform.from_euler(0, math.nan, 0), "the angles 0,nan,0 are not all finite"),
        (lambda: Transform.from_quat([0, 0, 0, 0]), "length of 0"),
        (lambda: Transform.from_quat([0, math.inf, 0, 1]), "not finite"),
        (lambda: Transform.from_quat([0, 0, 1]), r"shape \(3,\)"),
        (lambda: Transform.from_parts(scale=0), "the scale 0 is out of range; give 1e-12 to 1e\\+12"),
        (lambda: Transform(scale=-1), "the scale -1 is out of range"),
        (lambda: Transform(scale=math.nan), "the scale nan is out of range"),
        (lambda: Transform.from_parts(translate=(0, 1e20, 0)), "the translation 0,1e\\+20,0 is out of range"),
        (lambda: Transform.from_parts(translate=(0, math.nan, 0)), "the translation 0,nan,0 is out of range"),
        (lambda: Transform(np.diag([1.0, 1, -1])), "not a rotation"),
        (lambda: Transform(np.eye(3) * 2), "not a rotation"),
        (lambda: Transform(np.full((3, 3), math.nan)), "not a rotation"),
        (lambda: Transform(np.eye(4)), r"shape \(4, 4\)"),
    ],
)
def test_wrong_transforms_are_refused(make: object, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        make()  # type: ignore[operator]


def test_a_transform_cannot_be_changed() -> None:
    rotation = np.eye(3)
    transform = Transform(rotation)
    rotation[0, 0] = 5
    assert transform.is_identity
    with pytest.raises(ValueError, match="read-only"):
        transform.translation[0] = 1


# Pictures


def scene() -> Splats:
    """Large splats whose colours depend on the direction."""
    splats = random_splats(400, sh_degree=3, seed=4)
    return dataclasses.replace(splats, scale=splats.scale * np.float32(4), sh=splats.sh * np.float32(2))


def picture(splats: Splats, transform: Transform) -> Image:
    """What a camera sees that was moved as the splats were; near and far, lengths too, go with it."""
    pose = look_at((0.4, -1.5, 5.0), (0, 0, 0), (0, -1, 0))
    moved = np.eye(4)
    moved[:3, :3] = transform.rotation @ pose[:3, :3]
    moved[:3, 3] = transform.scale * transform.rotation @ pose[:3, 3] + transform.translation
    camera = Camera(moved, 160, 120, (150.0, 150.0), (80.0, 60.0))
    settings = RasterSettings(near=0.01 * transform.scale, far=100 * transform.scale)
    return draw(shade([(splats, np.eye(4))], camera), camera, settings)


MOVES = [
    Transform.from_up("-y"),
    Transform.from_up("z"),
    Transform.from_parts(rotate=(25, -70, 130)),
    Transform.from_parts(up="-z", rotate=(3, 200, -41), scale=2.5, translate=(1, -2, 0.5)),
]


@pytest.mark.parametrize("transform", MOVES)
def test_a_camera_that_moves_along_sees_the_same_picture(transform: Transform) -> None:
    splats = scene()
    before, moved = picture(splats, Transform()), transform.apply(splats)
    assert before[..., 3].mean() > 0.2
    assert psnr(before, picture(moved, transform)) > SAME
    assert psnr(before, picture(dataclasses.replace(moved, sh=splats.sh), transform)) < OTHER  # SH not rotated


# Places on the Earth

DEGREES = st.floats(-89.9, 89.9)


def matrix_of(*place: float) -> np.ndarray:
    return np.array(earth_matrix(*place)).reshape(4, 4).T


def position(latitude: float, longitude: float, height: float) -> np.ndarray:
    """A point above the ellipsoid x^2/a^2 + y^2/a^2 + z^2/b^2 = 1, by the parametric latitude of its foot."""
    a, b = RADIUS, RADIUS * (1 - FLATTENING)
    phi, lam = math.radians(latitude), math.radians(longitude)
    beta = math.atan2(b * math.sin(phi), a * math.cos(phi))
    foot = np.array([a * math.cos(beta) * math.cos(lam), a * math.cos(beta) * math.sin(lam), b * math.sin(beta)])
    normal = foot / [a * a, a * a, b * b]
    return foot + height * normal / np.linalg.norm(normal)


@given(DEGREES, st.floats(-180, 180), st.floats(-1000, 1e5), st.floats(0, 360))
def test_the_axes_are_east_north_and_up_turned_by_the_heading(
    latitude: float, longitude: float, height: float, heading: float
) -> None:
    matrix = matrix_of(latitude, longitude, height, heading)
    np.testing.assert_allclose(matrix[:3, 3], position(latitude, longitude, height), atol=1e-6)
    axes = matrix[:3, :3]
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    step = 1e-4  # degrees; differences of positions point to where numbers grow
    here = position(latitude, longitude, height)
    north = position(latitude + step, longitude, height) - here
    east = position(latitude, longitude + step, height) - here
    north, east = north / np.linalg.norm(north), east / np.linalg.norm(east)
    turn = math.radians(heading)
    np.testing.assert_allclose(axes[:, 1], math.cos(turn) * north + math.sin(turn) * east, atol=1e-5)
    np.testing.assert_allclose(axes[:, 2], np.cross(east, north), atol=1e-5)


@given(DEGREES, st.floats(-179.9, 179.9), st.floats(-1000, 1e6), st.floats(0.1, 359.9))
def test_a_place_is_found_again(latitude: float, longitude: float, height: float, heading: float) -> None:
    found = place_of(earth_matrix(latitude, longitude, height, heading))
    assert (found.latitude, found.longitude) == pytest.approx((latitude, longitude), abs=1e-9)
    assert (found.height, found.heading) == pytest.approx((height, heading), abs=1e-5)


def test_poles_and_the_equator_have_their_matrices() -> None:
    np.testing.assert_allclose(matrix_of(0, 0)[:3, 3], [RADIUS, 0, 0])
    np.testing.assert_allclose(matrix_of(90, 0)[:3, 3], [0, 0, 6_356_752.314245], atol=1e-6)
    np.testing.assert_allclose(matrix_of(0, 90)[:3, :3], [[-1, 0, 0], [0, 0, 1], [0, 1, 0]], atol=1e-15)
    # Heading 90: the scene's forward axis, y, points east, and its right one south.
    np.testing.assert_allclose(matrix_of(0, 0, 0, 90)[:3, :3], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-15)
