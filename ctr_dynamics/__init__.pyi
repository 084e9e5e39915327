from ctr_dynamics.diagnosis.from_bags import diagnose as diagnose
from ctr_dynamics.errors import InputError as InputError
from ctr_dynamics.estimation.estimator import Estimator as Estimator
from ctr_dynamics.io import open_bag as open_bag
from ctr_dynamics.model.model import Model as Model
from ctr_dynamics.model.simulator import Inputs as Inputs
from ctr_dynamics.model.simulator import Simulator as Simulator
from ctr_dynamics.model.statics import Statics as Statics
from ctr_dynamics.parameters import Settings as Settings
from ctr_dynamics.robot_files import load_robot as load_robot
from ctr_dynamics.runtime.replay import replay as replay
from ctr_dynamics.simulation import load_scenario as load_scenario
from ctr_dynamics.simulation import simulate as simulate

__version__: str
