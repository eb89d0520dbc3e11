"""An action client that loses no answer."""
import threading
from typing import Any

import rclpy.action


class ActionClient(rclpy.action.ActionClient):
    """As rclpy's, for use in another thread than the one that spins.

    rclpy 7.1 notes a request only after it has been sent. An answer that another thread takes in
    between is ignored ("unexpected goal response"), and the caller waits for ever.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self._sending = threading.Lock()
        super().__init__(*arguments, **options)

    def send_goal_async(self, *arguments: Any, **options: Any) -> Any:
        """See rclpy."""
        with self._sending:
            return super().send_goal_async(*arguments, **options)

    def _cancel_goal_async(self, *arguments: Any) -> Any:
        with self._sending:
            return super()._cancel_goal_async(*arguments)

    def _get_result_async(self, *arguments: Any) -> Any:
        with self._sending:
            return super()._get_result_async(*arguments)

    async def execute(self, taken_data: Any) -> None:
        """See rclpy; not before what is being sent is noted."""
        with self._sending:
            pass
        await super().execute(taken_data)
