from .mtconnect_adapter import build_agent_devices as build_agent_devices
from .publisher_process import report_ready as report_ready
from .publisher_process import run_publisher as run_publisher
