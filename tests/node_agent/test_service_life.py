"""The node's process: it ends when told, and does not hang when one of its threads dies."""

from __future__ import annotations

import threading

import pytest
from ringdic_node.agent import ArmAsked, CameraRefused, LockCamera
from ringdic_node.cameras.camera import CameraGoneError
from ringdic_node.cameras.pattern import PatternCamera
from ringdic_node.clock import SystemClock
from ringdic_node.config import NodeConfig
from ringdic_node.service import NodeService, ServiceError
from ringdic_node.spool import Spool
from ringdic_node.wire import Arm, hash_of_settings


class BrokenCamera(PatternCamera):
    """A driver with a bug."""

    def lock(self, settings):
        raise ZeroDivisionError


def service_of(tmp_path, camera_type) -> NodeService:
    config = NodeConfig("ring", "201", "tcp/127.0.0.1:1", tmp_path / "spool", "pattern")
    clock = SystemClock()
    return NodeService(config, camera_type("201", clock), Spool(config.spool), clock)


def test_a_node_without_a_controller_waits_and_ends_when_told(tmp_path):
    service = service_of(tmp_path, PatternCamera)
    thread = threading.Thread(target=service.run, daemon=True)
    thread.start()
    thread.join(1.0)
    assert thread.is_alive(), "it keeps waiting for its controller"
    service.stop()
    thread.join(10)
    assert not thread.is_alive()


def test_settings_with_the_hash_of_others_lock_no_camera(tmp_path):
    """The hash goes into the manifest: it must be that of what the camera was locked to."""
    service = service_of(tmp_path, PatternCamera)
    refused = service._lock(LockCamera({"exposure_us": 77}, hash_of_settings({"exposure_us": 4000})))
    assert isinstance(refused, CameraRefused)
    assert "not theirs" in refused.reason


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_bug_in_the_cameras_thread_ends_the_node(tmp_path):
    service = service_of(tmp_path, BrokenCamera)
    service._events.put(ArmAsked(Arm("s", "board", {}, "0" * 64, ("201",)), 1))
    with pytest.raises(ServiceError, match="camera thread has died"):
        service.run()


class GoneCamera(PatternCamera):
    """A camera that delivers nothing, not even after a restart."""

    def lock(self, settings):
        raise CameraGoneError("the camera gives no frames, not even after a restart")


class HangingCamera(PatternCamera):
    """A driver that does not return."""

    def lock(self, settings):
        threading.Event().wait(5)
        return super().lock(settings)


@pytest.mark.parametrize(
    ("camera_type", "told"), [(GoneCamera, "not even after a restart"), (HangingCamera, "it hangs")]
)
def test_a_dead_camera_is_told_and_ends_the_process_for_a_new_one(tmp_path, monkeypatch, camera_type, told):
    monkeypatch.setattr("ringdic_node.service.CAMERA_LIMIT_NS", 100_000_000)
    service = service_of(tmp_path, camera_type)
    sent = []
    service._events.put(ArmAsked(Arm("s", "board", {}, "0" * 64, ("201",)), 1))
    monkeypatch.setattr("ringdic_node.link.NodeLink.publish_status", lambda link, message: sent.append(message))
    with pytest.raises(ServiceError, match=told) as ended:
        service.run()
    assert ended.value.exit_code == 3
    assert told in sent[-1].detail
    if camera_type is GoneCamera:
        assert service._agent.state == "idle", "the refusal was told before the end"
