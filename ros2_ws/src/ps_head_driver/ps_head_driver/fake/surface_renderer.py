"""Pictures of the surfaces of scenes.py under a head."""
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ps_head_driver.camera_model import pixel_rays, scaled_camera
from ps_head_driver.fake.kernels import KERNEL_LOCK
from ps_head_driver.fake.renderer import Renderer, Sensor, corners, emitters
from ps_head_driver.fake.scenes import SIZE, Scene, make_scene
from ps_head_driver.fake.shading import shade
from ps_head_driver.fake.shadows import shadow_ground
from ps_head_driver.fake.spline_surface import intersect
from ps_head_driver.frames import slope_to_normal
from ps_head_driver.head_model import CameraGeometry, HeadModel
from ps_head_driver.kinematics import PanelPose
from ps_head_driver.stack import Truth

#: Emitters along a panel's width and height: where all of a matt or a glossy point's panel is
#: visible, and where part of it is.
MATT, GLOSSY, PARTIAL = (5, 3), (12, 6), (10, 5)

_DEEPEST, _BORDER = 0.010, 0.004     # m; a scene reaches this far below the plane, and aside


def camera_rays(camera: CameraGeometry) -> tuple[NDArray, NDArray]:
    """Directions of all pixels in ps_head_plane axes, scaled to z = -1.

    :returns: x and y, each (H * W,) float64.
    """
    v, u = np.mgrid[:camera.height_px, :camera.width_px]
    rays = pixel_rays(camera, np.stack([u, v], axis=-1)).reshape(-1, 3)
    return np.ascontiguousarray(rays[:, 0]), np.ascontiguousarray(rays[:, 1])


class SurfaceRenderer(Renderer):
    """Pictures and truth of one scene under one head.

    :param scene: what lies under the head.

    The other parameters are those of Renderer.
    """

    def __init__(self, scene: Scene, head: HeadModel, sensor: Sensor | None = None,
                 scale: float = 1.0, seed: int = 1, cache_bytes: int = 400_000_000) -> None:
        super().__init__(head, sensor, scale, seed, cache_bytes)
        self.scene = scene
        rays = camera_rays(self.camera)
        scene.require_covers(rays, self.camera.camera_standoff)
        with KERNEL_LOCK:
            self._points = intersect(
                scene.height, scene.albedo, *scene.origin, scene.pitch, *scene.height_range,
                *rays, self.camera.camera_standoff)
        self._ground = shadow_ground(scene.height, scene.height_range[1], *scene.origin,
                                     scene.pitch)

    @property
    def albedo(self) -> NDArray:
        """Diffuse reflectance of what each pixel sees, (H, W) float32."""
        return np.asarray(self._points[5].reshape(self.shape))

    def truth(self) -> Truth:
        """True normals (n_plane) and heights where the pixels really look."""
        points = self._points.reshape(6, *self.shape)
        return Truth(normal=slope_to_normal(np.stack([points[3], points[4]], axis=-1)),
                     height=points[2].copy())

    def warm_up(self) -> None:
        """Compile the kernels now, not with the first picture."""
        self._shade(self._points[:, :1], self._bright.panel_pose('E', 0.5))

    def _trace(self, pose: PanelPose) -> NDArray:
        return self._shade(self._points, pose).reshape(self.shape)

    def _shade(self, points: NDArray, pose: PanelPose) -> NDArray:
        scene = self.scene
        lobe = None if pose.lobe_exponent == 1 else pose.lobe_exponent
        with KERNEL_LOCK:
            return np.asarray(shade(
                points, (scene.specular, scene.roughness), lobe,
                *emitters(pose, GLOSSY if scene.specular else MATT, gauss=True),
                *emitters(pose, PARTIAL, gauss=False), corners(pose), pose.intensity,
                *self._ground, self.camera.camera_standoff))


def make_surface_renderer(name: str, arguments: dict[str, Any], head: HeadModel,
                          sensor: Sensor | None, scale: float, seed: int) -> SurfaceRenderer:
    """Renderer of a scene that fills the head's field of view.

    :raises PsError: SEQUENCER_BAD_REQUEST for an unknown scene or argument.
    """
    rays = camera_rays(scaled_camera(head.camera, 64, 64))
    reach = head.camera.camera_standoff + _DEEPEST
    width, height = (max(least, 2 * float(np.abs(along).max()) * reach + _BORDER)
                     for least, along in zip(SIZE, rays, strict=True))
    return SurfaceRenderer(make_scene(name, size=(width, height), **arguments), head, sensor,
                           scale, seed)
