"""Weight files made by hand, byte by byte: both torch containers, safetensors, and hostile ones."""

import hashlib
import io
import os
import pickle
import struct
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy

from starjax.models import pretrained, resnet, torch_file

STORAGES = {"f4": "FloatStorage", "f8": "DoubleStorage", "i8": "LongStorage", "f2": "HalfStorage"}


def text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def number(value: int) -> bytes:
    return b"J" + struct.pack("<i", value)


def numbers(values) -> bytes:
    return b"(" + b"".join(number(v) for v in values) + b"t"


def tensor_program(key, kind, numel, size, stride, offset=0) -> bytes:
    """Opcodes by which torch writes one tensor: its function, its storage and its view."""
    storage = b"(" + text("storage") + f"ctorch\n{STORAGES[kind]}\n".encode() + text(key)
    storage += text("cpu") + number(numel) + b"tQ"
    view = number(offset) + numbers(size) + numbers(stride) + b"\x89ccollections\nOrderedDict\n)R"
    return b"ctorch._utils\n_rebuild_tensor_v2\n(" + storage + view + b"tR"


def state_program(entries: dict[str, bytes]) -> bytes:
    """A pickle of an OrderedDict with `_metadata`, as `torch.save(module.state_dict())` makes."""
    items = b"".join(text(name) + program for name, program in entries.items())
    metadata = b"}" + text("_metadata") + b"}sb"
    return b"\x80\x02ccollections\nOrderedDict\n)Rq\x00(" + items + b"u" + metadata + b"."


def strides(shape):
    return [int(np.prod(shape[i + 1 :])) for i in range(len(shape))]


def programs(arrays):
    return {
        name: tensor_program(str(i), a.dtype.str[1:], a.size, a.shape, strides(a.shape))
        for i, (name, a) in enumerate(arrays.items())
    }


def write_zip(path, program, buffers, **extra):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("model/data.pkl", program)
        for i, buffer in enumerate(buffers):
            archive.writestr(f"model/data/{i}", buffer)
        for name, content in extra.items():
            archive.writestr(f"model/{name}", content)
    return path


def write_legacy(path, arrays):
    file = io.BytesIO()
    for value in (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True, "type_sizes": {"int": 4}}):
        file.write(pickle.dumps(value, protocol=2))
    file.write(state_program(programs(arrays)))
    file.write(pickle.dumps([str(i) for i in range(len(arrays))], protocol=2))
    for array in arrays.values():
        file.write(struct.pack("<q", array.size) + array.tobytes())
    path.write_bytes(file.getvalue())
    return path


def some_arrays():
    rng = np.random.default_rng(0)
    return {
        "conv.weight": rng.normal(size=(4, 3, 2, 2)).astype(np.float32),
        "half": rng.normal(size=(5,)).astype(np.float16),
        "double": rng.normal(size=(2, 2)),
        "batches": np.array([7], np.int64),
        "empty": np.zeros((0, 3), np.float32),
    }


def zip_of(path, arrays):
    return write_zip(path, state_program(programs(arrays)), [a.tobytes() for a in arrays.values()])


@pytest.mark.parametrize("write", [zip_of, write_legacy])
def test_both_containers_give_back_every_tensor(write, tmp_path):
    arrays = some_arrays()
    found = torch_file.read(write(tmp_path / "model.pth", arrays))
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


def test_views_of_a_shared_storage(tmp_path):
    """A transposed and an offset view of the same buffer."""
    buffer = np.arange(12, dtype=np.float32)
    program = state_program(
        {
            "transposed": tensor_program("0", "f4", 12, (4, 3), (1, 4)),
            "tail": tensor_program("0", "f4", 12, (2,), (5,), offset=6),
        }
    )
    found = torch_file.read(write_zip(tmp_path / "v.pth", program, [buffer.tobytes()]))
    np.testing.assert_array_equal(found["transposed"], buffer.reshape(3, 4).T)
    np.testing.assert_array_equal(found["tail"], [6.0, 11.0])


class Attack:
    """Makes a directory if it is ever unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.mark.parametrize("protocol", range(6))
def test_a_pickle_that_calls_something_is_refused_and_not_run(protocol, tmp_path):
    proof = tmp_path / "run"
    program = pickle.dumps({"conv1.weight": Attack(proof)}, protocol=protocol)
    path = write_zip(tmp_path / "attack.pth", program, [])
    with pytest.raises(ValueError, match="not a readable torch state dictionary"):
        torch_file.read(path)
    assert not proof.exists()
    pickle.loads(program)  # the attack is real
    assert proof.exists()


@pytest.mark.parametrize(
    ("program", "message"),
    [
        (b"cos\nsystem\n(X\x04\x00\x00\x00truetR.", "call of os.system is not allowed"),
        (b"cbuiltins\neval\n(X\x01\x00\x00\x001tR.", "call of builtins.eval is not allowed"),
        (b"\x80\x04\x8c\x02os\x8c\x06system\x93)R.", "call of os.system is not allowed"),
        (b"(ios\nsystem\n.", "opcode INST is not allowed"),
        (b"(cos\nsystem\no.", "opcode OBJ is not allowed"),
        (b"cos\nsystem\n)\x81.", "opcode NEWOBJ is not allowed"),
        (b"ccollections\nOrderedDict\n(]tR.", "OrderedDict with arguments"),
        (b"}(\x85\x85K\x01u.", ""),
        (b"}()K\x01u.", "key of type tuple"),
        (b"K\x01.", "expected a dictionary of tensors, got int"),
        (b"}", ""),
        (b"", ""),
        (b"0.", ""),
        (b"h\x05.", ""),
        (b"K\x01K\x02a.", ""),
        (b"X\xff\xff\xff\x7fabc.", ""),
        (b"(X\x01\x00\x00\x00aX\x01\x00\x00\x00btQ.", ""),
    ],
)
def test_broken_and_hostile_pickles_are_value_errors(program, message, tmp_path):
    path = write_zip(tmp_path / "bad.pth", program, [])
    with pytest.raises(ValueError, match=rf"bad\.pth: not a readable.*{message}"):
        torch_file.read(path)


@pytest.mark.parametrize(
    ("size", "stride", "offset", "numel"),
    [
        ((5,), (1,), 0, 4),  # past the end
        ((4,), (1,), 1, 4),
        ((2,), (4,), 0, 4),
        ((4,), (-1,), 3, 4),
        ((1,), (1,), -1, 4),
        ((2**20,), (0,), 0, 4),  # one element shown a million times
        ((2, 2), (1,), 0, 4),
        ((8,), (1,), 0, 8),  # the storage claims more than the file holds
    ],
)
def test_views_outside_their_storage_are_refused(size, stride, offset, numel, tmp_path):
    program = state_program({"w": tensor_program("0", "f4", numel, size, stride, offset)})
    path = write_zip(tmp_path / "view.pth", program, [bytes(16)])
    with pytest.raises(ValueError, match="not a readable torch state dictionary"):
        torch_file.read(path)


@pytest.mark.parametrize("write", [zip_of, write_legacy])
def test_truncated_files_are_refused(write, tmp_path):
    path = write(tmp_path / "model.pth", some_arrays())
    content = path.read_bytes()
    for end in range(0, len(content), 37):
        path.write_bytes(content[:end])
        with pytest.raises(ValueError, match="not a readable torch state dictionary"):
            torch_file.read(path)


def test_big_endian_files_are_refused(tmp_path):
    path = write_zip(tmp_path / "b.pth", state_program({}), [], byteorder="big")
    with pytest.raises(ValueError, match="little-endian"):
        torch_file.read(path)


@pytest.fixture(scope="module")
def trunk():
    """Parameters of a narrow ResNet-18."""
    init = jax.jit(resnet.ResNet18(width=16).init)
    return init(jax.random.key(0), jnp.zeros((1, 64, 64, 3)))["params"]


@pytest.fixture(scope="module")
def weights():
    """A torchvision state dictionary of that width, with its norms and classifier."""
    rng = np.random.default_rng(1)
    shapes = {"conv1.weight": (16, 3, 7, 7), "bn1.weight": (16,), "fc.weight": (10, 128)}
    for stage in range(4):
        width = 16 << stage
        for block in range(2):
            name, into = f"layer{stage + 1}.{block}", width // 2 if stage and not block else width
            shapes[f"{name}.conv1.weight"] = (width, into, 3, 3)
            shapes[f"{name}.conv2.weight"] = (width, width, 3, 3)
            shapes[f"{name}.bn2.running_var"] = (width,)
            if stage and not block:
                shapes[f"{name}.downsample.0.weight"] = (width, into, 1, 1)
    return {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}


def save_safetensors(path, weights):
    path = path.with_suffix(".safetensors")
    safetensors.numpy.save_file(weights, path)
    return path


@pytest.mark.parametrize("write", [zip_of, write_legacy, save_safetensors])
def test_every_convolution_is_filled_and_nothing_else(write, trunk, weights, tmp_path):
    filled = pretrained.load_resnet18(trunk, write(tmp_path / "resnet18.pth", weights))
    assert jax.tree.structure(filled) == jax.tree.structure(trunk)
    for path, leaf in jax.tree_util.tree_leaves_with_path(filled):
        names = [entry.key for entry in path]
        if names[-1] == "kernel":
            name = ".".join(names[:-1]).replace("_", ".") + ".weight"
            np.testing.assert_array_equal(leaf, np.einsum("oihw->hwio", weights[name]))
            assert leaf.dtype == jnp.float32
        else:
            np.testing.assert_array_equal(leaf, 1.0 if names[-1] == "scale" else 0.0)


def test_a_filled_convolution_is_torchs_cross_correlation(trunk, weights, tmp_path):
    """The stem's response to a single bright pixel is its kernel, mirrored."""
    filled = pretrained.load_resnet18(trunk, zip_of(tmp_path / "r.pth", weights))
    image = jnp.zeros((1, 16, 16, 3)).at[0, 8, 6, 1].set(1.0)
    out = resnet.Conv2d(16, 7, 2).apply({"params": filled["conv1"]}, image)
    kernel = weights["conv1.weight"]
    for row, column in ((4, 2), (3, 3), (5, 4)):
        tap = kernel[:, 1, 8 - (2 * row - 3), 6 - (2 * column - 3)]
        np.testing.assert_allclose(out[0, row, column], tap, rtol=1e-6)


def test_missing_misshapen_and_non_finite_weights_are_named(trunk, weights, tmp_path):
    name = "layer3.0.downsample.0.weight"
    cases = {
        "is missing": {k: v for k, v in weights.items() if k != name},
        r"expected shape \(64, 32, 1, 1\), got \(64, 32, 3, 3\)": {
            **weights,
            name: np.zeros((64, 32, 3, 3), np.float32),
        },
        "expected finite values": {**weights, name: weights[name] * np.nan},
    }
    for message, changed in cases.items():
        path = zip_of(tmp_path / "r.pth", changed)
        with pytest.raises(ValueError, match=rf"layer3\.0\.downsample\.0\.weight:? {message}"):
            pretrained.load_resnet18(trunk, path)


def test_the_hash_in_the_name_is_checked(weights, tmp_path):
    path = zip_of(tmp_path / "plain.pth", weights)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    good = path.rename(tmp_path / f"resnet18-{digest[:8]}.pth")
    assert "conv1.weight" in pretrained.read_weights(good)
    bad = good.rename(tmp_path / "resnet18-f37072fd.pth")
    with pytest.raises(ValueError, match=r"expected sha256 f37072fd\.\., got"):
        pretrained.read_weights(bad)
    dated = tmp_path / "resnet18-20240115.safetensors"
    safetensors.numpy.save_file({"conv1.weight": np.zeros(1, np.float32)}, dated)
    assert "conv1.weight" in pretrained.read_weights(dated)


def test_files_of_no_known_kind_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"encoder weights: expected a file, got .*none\.pth"):
        pretrained.read_weights(tmp_path / "none.pth")
    (tmp_path / "w.onnx").write_bytes(b"")
    with pytest.raises(ValueError, match=r"expected \.pth, \.pt or \.safetensors"):
        pretrained.read_weights(tmp_path / "w.onnx")
    (tmp_path / "w.safetensors").write_bytes(b"\xff" * 64)
    with pytest.raises(ValueError, match="not a readable safetensors file"):
        pretrained.read_weights(tmp_path / "w.safetensors")


def test_files_too_large_unpacked_are_refused(tmp_path, monkeypatch):
    arrays = {"w": np.zeros(4096, np.float32)}
    program, buffers = state_program(programs(arrays)), [arrays["w"].tobytes()]
    path = tmp_path / "bomb.pth"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("model/data.pkl", program)
        archive.writestr("model/data/0", buffers[0])
    assert path.stat().st_size < 2000
    assert torch_file.read(path).keys() == {"w"}
    monkeypatch.setattr(torch_file, "_MAX_BYTES", 2000)
    with pytest.raises(ValueError, match="at most 2000 bytes"):
        torch_file.read(path)
    program = state_program({n: tensor_program("0", "f4", 256, (256,), (1,)) for n in "abc"})
    small = write_zip(tmp_path / "shared.pth", program, [bytes(1024)])
    with pytest.raises(ValueError, match="at most 2000 bytes, got"):
        torch_file.read(small)


def test_parameters_are_tensors_too(tmp_path):
    """As `torch.save(dict(module.named_parameters()))` writes them."""
    tensor = tensor_program("0", "f4", 2, (2,), (1,))
    program = b"ctorch._utils\n_rebuild_parameter\n(" + tensor + b"\x89}tR"
    path = write_zip(
        tmp_path / "p.pth", state_program({"w": program}), [np.float32([1, 2]).tobytes()]
    )
    np.testing.assert_array_equal(torch_file.read(path)["w"], [1, 2])


def test_another_version_and_a_view_of_a_storage_are_refused(tmp_path):
    file = write_legacy(tmp_path / "old.pth", some_arrays())
    content = file.read_bytes()
    assert content.count(struct.pack("<H", 1001)) == 1
    file.write_bytes(content.replace(struct.pack("<H", 1001), struct.pack("<H", 1002)))
    with pytest.raises(ValueError, match="older container"):
        torch_file.read(file)
    # torch's older storages may begin within others: (key, offset, size)
    plain = tensor_program("0", "f4", 4, (4,), (1,))
    viewed = plain.replace(number(4) + b"tQ", number(4) + numbers((1, 2, 4)) + b"tQ")
    path = write_zip(
        tmp_path / "v.pth", state_program({"a": viewed}), [np.zeros(4, "f4").tobytes()]
    )
    with pytest.raises(ValueError, match="not a plain storage"):
        torch_file.read(path)
