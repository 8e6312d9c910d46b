from .drive.plant_physics import PlantPhysics as PlantPhysics
from .drive.plant_physics import build_plant_parameters as build_plant_parameters
from .fault_script import load_script as load_script
from .frame_faults import FrameFault as FrameFault
from .simulated_machine import SimulatedMachine as SimulatedMachine
from .simulator_service import SimulatorService as SimulatorService
from .wire.fault_bus import FaultBus as FaultBus
