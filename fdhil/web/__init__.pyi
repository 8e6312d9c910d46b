from .fleet_app import make_fleet_app as make_fleet_app
from .serving import require_extra as require_extra
from .serving import serve_application as serve_application
from .serving import serve_machine as serve_machine
