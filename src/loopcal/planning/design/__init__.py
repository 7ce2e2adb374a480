# SPDX-License-Identifier: Apache-2.0
"""Choose n of N groups of rows by a criterion of optimal design; nothing here knows a robot."""

from loopcal.planning.design.certified_design import CertifiedDesign as CertifiedDesign
from loopcal.planning.design.certified_design import DesignCurve as DesignCurve
from loopcal.planning.design.certified_design import SmallestDesign as SmallestDesign
from loopcal.planning.design.certified_design import choose_design as choose_design
from loopcal.planning.design.certified_design import compute_design_curve as compute_design_curve
from loopcal.planning.design.certified_design import find_smallest_design as find_smallest_design
from loopcal.planning.design.criteria import A as A
from loopcal.planning.design.criteria import Criterion as Criterion
from loopcal.planning.design.criteria import D as D
from loopcal.planning.design.criteria import E as E
from loopcal.planning.design.criteria import I as I
from loopcal.planning.design.criteria import compute_efficiency as compute_efficiency
from loopcal.planning.design.criteria import evaluate_criterion as evaluate_criterion
from loopcal.planning.design.criteria import is_full_rank as is_full_rank
from loopcal.planning.design.design_space import Design as Design
from loopcal.planning.design.design_space import ObservableSpace as ObservableSpace
from loopcal.planning.design.design_space import PriorInformation as PriorInformation
from loopcal.planning.design.design_space import divide_by_factor as divide_by_factor
from loopcal.planning.design.design_space import factor_design as factor_design
from loopcal.planning.design.design_space import factor_rows as factor_rows
from loopcal.planning.design.design_space import find_observable_space as find_observable_space
from loopcal.planning.design.design_space import is_allowed as is_allowed
from loopcal.planning.design.exchange import MovedDesign as MovedDesign
from loopcal.planning.design.exchange import coordinate_exchange as coordinate_exchange
from loopcal.planning.design.exchange import fedorov_exchange as fedorov_exchange
from loopcal.planning.design.relaxation import RelaxedDesign as RelaxedDesign
from loopcal.planning.design.relaxation import relax_design as relax_design
