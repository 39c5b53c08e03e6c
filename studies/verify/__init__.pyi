from .result import ModelVerification as ModelVerification
from .rows import Assumption as Assumption
from .verb import verify as verify
