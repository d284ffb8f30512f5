"""Requests as openpi's clients make them: images of any size and type, one moment, a prompt."""

import mistakes
import numpy as np
import pytest
import served
from scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.deploy import client_log, images, inputs, requests, wire

SPEC = inputs.InputSpec(2, (), np.float32([0.0, 0.0, 0.15]), True, 32, ("scope",), 12)
PLACE = np.asarray(rcm.trocar_position(served.PORT, SPEC.p_world_ref))
RNG = np.random.default_rng(0)
IMAGE = RNG.integers(0, 256, (32, 32, 3), np.uint8)


def single(height=0.03, image=IMAGE):
    moment = served.moment(height)
    arrays = {"R": moment.pose.R, "p": moment.pose.p, "gripper": 1.0, "image": image}
    return arrays | {"trocar": PLACE, "prompt": "pick up the block"}


def decoded(request, history=None):
    history = history or requests.History(SPEC)
    value, moment = history.complete(request)
    request = wire.decode_request(SPEC, value)
    history.keep(moment)
    return request


def test_a_moment_is_completed_by_those_before_it():
    history = requests.History(SPEC)
    heights = [0.03, 0.04, 0.05]
    asked = [decoded(single(z), history).observation.pose.p[:, 2] for z in heights]
    np.testing.assert_allclose(asked, [[0.03, 0.03], [0.03, 0.04], [0.04, 0.05]], atol=1e-6)
    again = decoded(single(0.06) | {"reset": True}, history).observation
    np.testing.assert_allclose(again.pose.p[:, 2], 0.06, atol=1e-6)
    assert again.images["scope"].shape == (2, 32, 32, 3) and again.gripper.shape == (2,)


def test_a_moment_that_was_refused_is_forgotten():
    history = requests.History(SPEC)
    decoded(single(0.03), history)
    history.complete(single(0.09))  # without `keep`, as of a refused request
    np.testing.assert_allclose(
        decoded(single(0.04), history).observation.pose.p[:, 2], [0.03, 0.04], atol=1e-6
    )


def test_whole_requests_stay_as_they_are():
    both = {name: np.stack([x, x]) for name, x in single().items() if name in ("R", "p", "image")}
    both |= {"gripper": np.ones(2), "trocar": PLACE}
    value, moment = requests.History(SPEC).complete(both)
    assert moment is None and value["image"] is both["image"]
    for wrong in (both | {"p": both["p"][0]}, both | {"more": 1}, {}, [], 7):
        with pytest.raises(ValueError):
            decoded(wrong)


def test_columns_of_an_export():
    turned = Rotation.from_euler("z", 0.4) * Rotation.from_matrix(served.moment().pose.R)
    row = np.concatenate([served.moment().pose.p, turned.as_quat(), [0.5]]).astype(np.float32)
    request = {"observation/state": row, "observation/image": IMAGE, "observation/trocar": PLACE}
    seen = decoded(request | {"prompt": ""}).observation
    np.testing.assert_allclose(seen.pose.R[1], turned.as_matrix(), atol=1e-6)
    np.testing.assert_array_equal(seen.images["scope"][0], IMAGE)
    for column, value in (("state", row[:7]), ("state", 0.0 * row), ("state", "far")):
        with mistakes.of("observation/state"):
            decoded(request | {f"observation/{column}": value})


@pytest.mark.parametrize(
    "given",
    [
        IMAGE.astype(np.float32) / 255,
        IMAGE.astype(np.int64),
        np.moveaxis(IMAGE, -1, 0),
        np.moveaxis(IMAGE, -1, 0) / 255.0,
    ],
)
def test_other_types_and_orders_of_an_image_are_the_same_image(given):
    seen = decoded(single(image=given)).observation
    np.testing.assert_array_equal(seen.images["scope"], np.stack([IMAGE, IMAGE]))


def test_floats_are_rounded_not_cut():
    given = np.full((32, 32, 3), 199.7 / 255, np.float32)
    assert (images.adapt("image", given, 32, 2) == 200).all()


def test_an_image_of_another_size_keeps_its_ratio_between_black_bars():
    wide = np.full((48, 96, 3), 200, np.uint8)
    (seen, _) = decoded(single(image=wide)).observation.images["scope"]
    assert (seen[8:24] == 200).all() and not seen[:8].any() and not seen[24:].any()
    whole = images.adapt("image", np.stack([wide, wide]), 32, 2)
    np.testing.assert_array_equal(whole, np.stack([seen, seen]))


@pytest.mark.parametrize(
    "given",
    [
        IMAGE.astype(np.float32),  # 0 to 255
        IMAGE.astype(np.int32) - 1,
        np.full((32, 32, 3), np.nan),
        IMAGE > 7,
        IMAGE[..., :2],
        IMAGE[:0],
        np.zeros((10_000, 1, 1, 3), np.uint8),  # would grow to gigabytes
    ],
)
def test_an_image_that_is_none_is_one_line(given):
    with mistakes.of("image"):
        decoded(single(image=given))


def test_a_camera_of_a_robot_fits_a_frame():
    request = {name: np.asarray(x) for name, x in single().items() if name != "prompt"}
    request["image"] = np.zeros((2, *images.LARGEST, 3), np.float32)
    assert len(wire.pack(request)) <= wire.max_request_bytes(SPEC)


def test_a_log_has_a_line_a_reason():
    lines = []
    log = client_log.ClientLog(lines.append, "client 1")
    for i in range(40):
        log.refuse("image: expected\x1b[2J\nanother" if i < 20 else f"reason {i}")
    log.leave("")
    assert len(lines) < 10 and log.refused == 40
    assert all(line.startswith("client 1 ") and line.isprintable() for line in lines)


@pytest.mark.parametrize("shape", [(480, 640), (640, 480), (128, 128)])
def test_a_cameras_image_is_its_middle_square(shape):
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (*shape, 3), np.uint8)
    top, left = ((side - min(shape)) // 2 for side in shape)
    middle = image[top : top + min(shape), left : left + min(shape)]
    np.testing.assert_array_equal(images.square(image, min(shape)), middle)
    np.testing.assert_array_equal(images.square(image, min(shape), bgr=True), middle[..., ::-1])
    small = images.square(image, 64)
    assert small.shape == (64, 64, 3) and small.dtype == np.uint8
    assert abs(small.mean() - middle.mean()) < 2.0  # no black bars


@pytest.mark.parametrize("image", [np.zeros((4, 4)), np.zeros((0, 4, 3)), np.full((4, 4, 3), 2.0)])
def test_a_picture_that_is_none_is_one_line(image):
    with mistakes.of("image"):
        images.square(image, 8)
