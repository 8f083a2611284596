from .averages import AveragesEstimator as AveragesEstimator
from .reconstruction import TwoViewLocator as TwoViewLocator
from .stratified import StratifiedEstimator as StratifiedEstimator
