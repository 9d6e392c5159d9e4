# The public names, and where each is from: `__init__.py` reads them here, and type checkers do.
from gridworld.agents.sb3.exact_eval import ExactEvalCallback as ExactEvalCallback
from gridworld.agents.sb3.vec_env import make_vec_env as make_vec_env
from gridworld.api.playground import Playground as Playground
from gridworld.api.playground import playground as playground
from gridworld.api.runs import RunResult as RunResult
from gridworld.api.runs import diagnose as diagnose
from gridworld.api.runs import open_run as open_run
from gridworld.api.runs import train as train
from gridworld.api.settings import compose as compose
from gridworld.api.sweeps import SweepResult as SweepResult
from gridworld.api.sweeps import open_sweep as open_sweep
from gridworld.api.sweeps import record as record
from gridworld.api.sweeps import sweep as sweep
from gridworld.api.sweeps import tune as tune
from gridworld.api.worlds import compile_env as compile_env
from gridworld.api.worlds import evaluate as evaluate
from gridworld.api.worlds import make_vec as make_vec
from gridworld.base.errors import InputError as InputError
from gridworld.checking.run import CheckResult as CheckResult
from gridworld.checking.run import check as check
from gridworld.envs.env import GridWorldEnv as GridWorldEnv
from gridworld.envs.observations import CoordinateObservation as CoordinateObservation
from gridworld.envs.observations import ImageObservation as ImageObservation
from gridworld.envs.observations import OneHotObservation as OneHotObservation
from gridworld.envs.observations import VectorCoordinateObservation as VectorCoordinateObservation
from gridworld.envs.observations import VectorImageObservation as VectorImageObservation
from gridworld.envs.observations import VectorOneHotObservation as VectorOneHotObservation
from gridworld.envs.registration import ENV_ID as ENV_ID
from gridworld.envs.registration import register_envs as register_envs
from gridworld.envs.vector_env import GridWorldVectorEnv as GridWorldVectorEnv
from gridworld.examining.examine import ExamineResult as ExamineResult
from gridworld.examining.examine import examine as examine
from gridworld.training.verify import verify as verify
from gridworld.world.evaluation import Evaluator as Evaluator
from gridworld.world.evaluation import Score as Score
from gridworld.world.grid import compile_mdp as compile_mdp
from gridworld.world.layout import Layout as Layout
from gridworld.world.layout import load as load
from gridworld.world.layout import shipped_layouts as shipped_layouts
from gridworld.world.mdp import Mdp as Mdp
from gridworld.world.sources.arrays import load_world as load_world

__all__: list[str]
__version__: str
