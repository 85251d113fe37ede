"""A camera of the simulated rig: it renders what the real one would see at the planned moment.

Building the camera compiles or loads its renderer. A node appears to the controller only after its camera is built, so
a node that is alive renders at full speed.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from ringdic_node.cameras.camera import CameraError, Frame, Lock, Shot, check_settings
from ringdic_node.clock import Clock, sleep_until


class VirtualNodeCamera:
    """One camera of the simulated ring of the paper. Needs the extra ``virtual``, which has the renderer's packages.

    Parameters
    ----------
    camera : str
        Id of a camera of the simulated rig, ``cam_01`` and so on.
    cameras, scale, seed
        Size of the ring, scale of the images, seed of the rig's scatter and of the noise.
    specimen : str
        ``limb`` or ``cylinder``.
    jitter_us, offset_us : float
        Standard deviations of each frame's time and of this camera's constant delay, about the planned moment, µs.
    """

    def __init__(
        self,
        camera: str,
        clock: Clock,
        *,
        cameras: int = 12,
        scale: float = 0.25,
        seed: int = 0,
        specimen: str = "limb",
        jitter_us: float = 30.0,
        offset_us: float = 20.0,
    ) -> None:
        try:
            from ringdic_node.virtual_rig.render import load_renderer
            from ringdic_node.virtual_rig.rig import paper_rig

            ring = {lens.id: lens for lens in paper_rig(cameras=cameras, scale=scale, seed=seed).cameras}
            load_renderer(specimen)
        except ImportError as error:
            raise CameraError(
                f"the simulated rig cannot be loaded ({error}); install the extra: pip install 'ringdic[virtual]'"
            ) from error
        except ValueError as error:
            raise CameraError(f"the simulated rig cannot be built: {error}") from error
        if camera not in ring:
            raise CameraError(f"the simulated rig has no camera '{camera}'; it has {', '.join(ring)}")
        self._lens = ring[camera]
        self.camera = camera
        self._clock = clock
        self._seed = seed
        self._specimen = specimen
        self._random = np.random.default_rng([seed, zlib.crc32(camera.encode())])
        self._jitter_us = jitter_us
        self._offset_us = float(self._random.normal(0.0, offset_us))
        self._exposure_us = 5000.0

    def lock(self, settings: Mapping[str, Any]) -> Lock:
        """Check the settings and note the exposure; the rendered brightness does not depend on them."""
        check_settings(settings)
        self._exposure_us = float(settings.get("exposure_us", self._exposure_us))
        return Lock(
            metadata={"ExposureTime": self._exposure_us, **settings},
            sync="simulated",
            image_bytes=self._lens.width * self._lens.height,
        )

    def capture(self, shot: Shot) -> Frame:
        """Render the scene of this shot. Raises CameraError if it cannot be rendered."""
        from ringdic_node.virtual_rig.render import render
        from ringdic_node.virtual_rig.scenes import scene

        current_scene = scene(shot.kind, shot.scene, specimen=self._specimen, seed=self._seed)
        noise = zlib.crc32(f"{self._seed}/{self.camera}/{shot.kind}/{shot.scene}".encode())
        sleep_until(self._clock, shot.fire_at_ns)
        pixels = render(self._lens, current_scene, noise)
        delay_us = self._offset_us + self._random.normal(0.0, self._jitter_us)
        return Frame(
            pixels=pixels,
            time_ns=shot.fire_at_ns + round(1000 * delay_us),
            exposure_us=self._exposure_us,
            metadata={"scene": f"{shot.kind} {shot.scene}", "specimen": self._specimen},
        )

    def versions(self) -> dict[str, str]:
        """Name of this kind of camera."""
        return {"camera": "virtual"}

    def close(self) -> None:
        """Do nothing: this camera holds nothing open."""
