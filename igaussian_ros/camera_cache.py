"""The last valid camera of each image size and frame."""

from __future__ import annotations

from sensor_msgs.msg import CameraInfo

from igaussian_core.camera import Camera
from igaussian_ros.convert import MessageError, camera_from_ros


class CameraCache:
    """Cameras by (width, height, frame_id); an invalid camera_info leaves them as they are.

    Cameras change rarely and their messages may be lost or late, so that images are not held
    back until a camera_info of the same stamp has arrived.
    """

    def __init__(self, rectified: bool = False) -> None:
        self._rectified = rectified
        self._cameras: dict[tuple[int, int, str], Camera] = {}

    def update(self, message: CameraInfo, frame_id: str) -> Camera:
        """Keep the message's camera.

        Raises:
            CameraError: a camera_info that cannot be used; what was known stays.
        """
        camera = camera_from_ros(message, self._rectified)
        self._cameras[camera.width, camera.height, frame_id] = camera
        return camera

    def find(self, width: int, height: int, frame_id: str) -> Camera:
        """The camera of an image of this size and frame.

        An empty frame_id on either side matches any frame.

        Raises:
            MessageError: there is none; the text says which there are.
        """
        known = dict(self._cameras)
        exact = known.get((width, height, frame_id))
        if exact is not None:
            return exact
        for (w, h, frame), camera in known.items():
            if (w, h) == (width, height) and not (frame and frame_id):
                return camera
        raise MessageError(
            f"no valid camera_info for images of {width}x{height} in frame '{frame_id}'; "
            f"received: {self}"
        )

    def __str__(self) -> str:
        """The sizes and frames that are known."""
        known = sorted(self._cameras)
        return ", ".join(f"{w}x{h} in '{frame}'" for w, h, frame in known) or "none yet"

    def clear(self) -> None:
        self._cameras.clear()
