from .rows import Assumption as Assumption
from .run import ModelVerification as ModelVerification
from .run import verify_study as verify_study
