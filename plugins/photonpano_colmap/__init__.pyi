from .averages import AveragesEstimator as AveragesEstimator
from .stratified import StratifiedEstimator as StratifiedEstimator
from .two_view import TwoViewLocator as TwoViewLocator
