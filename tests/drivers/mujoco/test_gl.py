import threading

import pytest

from drivers.mujoco import gl


@pytest.fixture(autouse=True)
def no_cache():
    gl.select_gl.cache_clear()
    yield
    gl.select_gl.cache_clear()


def chosen(monkeypatch, *, named="", egl=False, osmesa=False):
    monkeypatch.setenv(gl.VARIABLE, named)
    monkeypatch.setattr(gl, "has_egl", lambda: egl)
    monkeypatch.setattr(gl.ctypes.util, "find_library", lambda name: "libOSMesa.so.8" if osmesa else None)
    return gl.select_gl()


def test_egl_precedes_osmesa_and_ray_casting(monkeypatch, caplog):
    for available, selected in (({"egl": True, "osmesa": True}, "egl"), ({"osmesa": True}, "osmesa"), ({}, "")):
        gl.select_gl.cache_clear()
        assert chosen(monkeypatch, **available) == selected
    assert "apt-get install libegl1 libgl1-mesa-dri libopengl0" in caplog.text


@pytest.mark.parametrize(("named", "found"), [("osmesa", "osmesa"), (" EGL ", "egl"), ("off", ""), ("glfw", "egl")])
def test_variable_selects_an_offscreen_backend(monkeypatch, named, found):
    assert chosen(monkeypatch, named=named, egl=True) == found


def test_missing_library_means_no_egl(monkeypatch):
    def missing(name):
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(gl.ctypes, "CDLL", missing)
    assert not gl.has_egl()


def test_single_thread_runs_all_calls_on_one_thread():
    run, found = gl.SingleThread("test"), set()
    found.add(run(threading.get_ident))
    other = threading.Thread(target=lambda: found.add(run(threading.get_ident)))
    other.start()
    other.join()
    assert len(found) == 1 and threading.get_ident() not in found
    with pytest.raises(ValueError, match="of the call"):
        run(lambda: (_ for _ in ()).throw(ValueError("of the call")))
    run.close()
