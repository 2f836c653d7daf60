"""Whatever happens to the binary is one clear message, nothing partial is loaded, and Blender lives."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import bpy
import pytest
from conftest import BINARY, MODULE, fake_binary, override, read_exr, use_multilayer_exr

# A render that takes minutes: cancelling it is cancelling something. 64 x 48 receivers.
MANY_SAMPLES = "1000000"


def module(name: str):
    """A module of the add-on."""
    return sys.modules[f"{MODULE}.{name}"]


def start(scene):
    """A running preview, whose binary is at work."""
    preview = module("preview").start(bpy.context)
    module("preview").Preview.current = preview
    return preview


def finish(preview) -> str:
    """The message of a preview that has come to its end."""
    while preview.step():
        time.sleep(0.01)
    return preview.message


def process_of(preview) -> subprocess.Popen:
    """The running process of a preview."""
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        run = preview.job._run
        if run is not None and run._process is not None:
            return run._process
        time.sleep(0.01)
    raise AssertionError("the binary was not started")


def images() -> list[str]:
    """Images that a preview made."""
    return [image.name for image in bpy.data.images if image.name.startswith("Penumbra")]


@pytest.mark.timeout(60)
def test_cancelling_kills_the_binary_within_a_second(scene):
    override(scene.penumbra, "samples", MANY_SAMPLES)
    preview = start(scene)
    process = process_of(preview)
    before = time.monotonic()
    assert bpy.ops.penumbra.cancel() == {"FINISHED"}
    assert finish(preview) == "cancelled"
    assert time.monotonic() - before < 1.0
    assert process.poll() is not None
    assert images() == []


@pytest.mark.timeout(60)
def test_progress_is_told_while_the_binary_works(scene):
    override(scene.penumbra, "samples", "20000")
    preview = start(scene)
    seen = set()
    while preview.step():
        seen.add((preview.job.fraction, preview.job.label))
        time.sleep(0.005)
    assert preview.message == ""
    fractions = [fraction for fraction, label in seen if label == "rays"]
    assert len(fractions) > 3 and max(fractions) > 0.5


@pytest.mark.timeout(60)
def test_a_killed_binary_is_a_message(scene):
    override(scene.penumbra, "samples", MANY_SAMPLES)
    preview = start(scene)
    process_of(preview).send_signal(signal.SIGKILL)
    assert finish(preview) == "penumbra was killed by SIGKILL"
    assert images() == []


@pytest.mark.timeout(60)
def test_a_crashing_binary_is_a_message(scene, preferences, tmp_path):
    preferences.binary = str(fake_binary(tmp_path / "penumbra", "os.abort()"))
    assert finish(start(scene)) == "penumbra was killed by SIGABRT"


@pytest.mark.timeout(60)
def test_a_hanging_binary_is_stopped_even_if_it_does_not_listen(scene, preferences, tmp_path):
    script = "import signal\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\ntime.sleep(600)"
    preferences.binary = str(fake_binary(tmp_path / "penumbra", script))
    preferences.stall_seconds = 1.0
    before = time.monotonic()
    preview = start(scene)
    process = process_of(preview)
    assert finish(preview) == "penumbra made no progress for 1 s and was stopped"
    # A second of patience, and less than one to end it, and what starting Python takes.
    assert time.monotonic() - before < 4.0
    assert process.poll() is not None


@pytest.mark.timeout(60)
def test_a_binary_that_works_on_is_not_stopped(scene, preferences, tmp_path):
    script = (
        "for percent in range(20):\n"
        "    print(f'progress: {percent} slow', file=sys.stderr, flush=True)\n"
        "    time.sleep(0.1)\n"
        f"sys.exit(subprocess.run([{str(BINARY)!r}, *sys.argv[1:]]).returncode)"
    )
    preferences.binary = str(fake_binary(tmp_path / "penumbra", script))
    preferences.stall_seconds = 1.0
    assert finish(start(scene)) == ""


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    ("name", "content", "mode", "message"),
    [
        ("missing", None, 0, "no penumbra binary at"),
        ("plain", "text", 0o644, "is not executable"),
        ("garbage", "\x7fELF no program", 0o755, "could not be started"),
        ("other", "#!/bin/sh\necho hello\n", 0o755, "printed no JSON|not an OpenEXR|No such file"),
    ],
)
def test_what_is_no_penumbra_binary_is_a_message(scene, preferences, tmp_path, name, content, mode, message):
    path = tmp_path / name
    if content is not None:
        path.write_text(content)
        path.chmod(mode)
    preferences.binary = str(path)
    with pytest.raises(RuntimeError, match=message):
        bpy.ops.penumbra.preview()
    assert images() == []


@pytest.mark.timeout(60)
def test_a_full_disk_under_the_binary_is_its_message(scene, preferences, tmp_path):
    script = "print('error: image.exr: No space left on device (os error 28)', file=sys.stderr)\nsys.exit(1)"
    preferences.binary = str(fake_binary(tmp_path / "penumbra", script))
    assert finish(start(scene)) == "penumbra: image.exr: No space left on device (os error 28)"
    assert images() == []


@pytest.mark.timeout(60)
@pytest.mark.parametrize("kilobytes", [1, 4])
def test_a_full_disk_is_a_message(scene, preferences, tmp_path, kilobytes):
    """A limit on the size of files stands for a disk that is full: with 1 KiB the scene does not fit, with 4 the image."""
    import resource

    # Python's children do not inherit that the limit's signal is ignored.
    script = f"import signal\nsignal.signal(signal.SIGXFSZ, signal.SIG_IGN)\nos.execv({str(BINARY)!r}, sys.argv)"
    preferences.binary = str(fake_binary(tmp_path / "penumbra", script))

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    scene.render.resolution_x = scene.penumbra.width = 256
    scene.penumbra.height = 192
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (kilobytes * 1024, before[1]))
        message = finish(start(scene))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert "File too large" in message
    assert "\n" not in message
    assert images() == []


@pytest.mark.timeout(60)
def test_no_space_left_is_said_in_plain_words(addon):
    import errno

    process = module("process")
    error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/somewhere/scene.glb")
    assert process.describe_os_error(error, "rendering") == "rendering failed: the disk is full (/somewhere/scene.glb)"


@pytest.mark.timeout(60)
@pytest.mark.parametrize("cut", [0, 4, 100, 1000, -1])
def test_a_partial_image_is_never_loaded(scene, preferences, tmp_path, cut):
    script = (
        f"status = subprocess.run([{str(BINARY)!r}, *sys.argv[1:]]).returncode\n"
        "path = sys.argv[sys.argv.index('-o') + 1]\n"
        "data = open(path, 'rb').read()\n"
        f"open(path, 'wb').write(data[:{cut}])\n"
        "sys.exit(status)"
    )
    preferences.binary = str(fake_binary(tmp_path / "penumbra", script))
    message = finish(start(scene))
    assert "image-0.exr" in message and "\n" not in message
    assert images() == []


@pytest.mark.timeout(60)
def test_nothing_is_left_in_the_temporary_folder(scene):
    override(scene.penumbra, "samples", MANY_SAMPLES)
    preview = start(scene)
    process_of(preview)
    module("preview").cancel_running()
    finish(preview)
    scene.penumbra.overrides.clear()
    assert finish(start(scene)) == ""
    assert not [name for name in os.listdir(bpy.app.tempdir) if name.startswith("penumbra-")]


@pytest.mark.timeout(60)
def test_no_binary_outlives_blender(extension_zip, tmp_path):
    pid_path = tmp_path / "pid"
    script = f"open({str(pid_path)!r}, 'w').write(str(os.getpid()))\ntime.sleep(600)"
    binary = fake_binary(tmp_path / "penumbra", script)
    code = (
        "import sys, time, pathlib, bpy\n"
        "bpy.ops.extensions.package_install_files(filepath=sys.argv[1], repo='user_default', enable_on_install=True)\n"
        f"bpy.context.preferences.addons['{MODULE}'].preferences.binary = sys.argv[2]\n"
        f"sys.modules['{MODULE}.preview'].start(bpy.context)\n"
        "while not pathlib.Path(sys.argv[3]).exists(): time.sleep(0.05)\n"
    )
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "user")}
    # Factory settings have a cube, a light and a camera.
    subprocess.run([sys.executable, "-c", code, extension_zip, binary, pid_path], env=environment, check=True, timeout=50)
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid_path.read_text()), 0)


def f12(scene, path):
    """A multilayer render that fails: its message. The file, if there is one, can be read."""
    scene.render.engine = "PENUMBRA"
    use_multilayer_exr(scene, path)
    with pytest.raises(RuntimeError) as raised:
        bpy.ops.render.render(write_still=True)
    if path.exists():
        read_exr(path)
    return str(raised.value)


@pytest.mark.timeout(60)
def test_a_final_render_without_a_binary_is_a_message(scene, preferences, tmp_path):
    preferences.binary = str(tmp_path / "missing")
    assert "no penumbra binary at" in f12(scene, tmp_path / "f12.exr")


@pytest.mark.timeout(60)
def test_a_final_render_whose_binary_crashes_is_a_message(scene, preferences, tmp_path):
    preferences.binary = str(fake_binary(tmp_path / "penumbra", "os.abort()"))
    assert "killed by SIGABRT" in f12(scene, tmp_path / "f12.exr")


@pytest.mark.timeout(60)
def test_a_final_render_never_raises(scene, monkeypatch, tmp_path):
    """An exception out of RenderEngine.render with a multilayer EXR ends Blender by a segmentation fault (4.5 to 5.2)."""

    def fail(*_):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(module("extract"), "extract", fail)
    assert "ZeroDivisionError: a bug" in f12(scene, tmp_path / "f12.exr")
    with pytest.raises(RuntimeError, match="ZeroDivisionError: a bug"):
        bpy.ops.penumbra.preview()
    monkeypatch.undo()
    assert bpy.ops.render.render() == {"FINISHED"}


@pytest.mark.timeout(60)
def test_a_cancelled_final_render_ends_within_a_second(scene, monkeypatch, tmp_path):
    override(scene.penumbra, "samples", MANY_SAMPLES)
    engine = module("engine").PenumbraRenderEngine
    asked = threading.Event()
    monkeypatch.setattr(engine, "is_stopped", lambda self: asked.is_set())
    asked_at = []

    def ask() -> None:
        asked_at.append(time.monotonic())
        asked.set()

    timer = threading.Timer(2.0, ask)
    scene.render.engine = "PENUMBRA"
    use_multilayer_exr(scene, tmp_path / "f12.exr")
    timer.start()
    bpy.ops.render.render()
    assert asked_at and time.monotonic() - asked_at[0] < 1.0
