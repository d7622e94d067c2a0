"""Error budgets: spectra of disturbances to the RMS position error and force of a closed loop."""

from ccd_casadi.budget.evaluation import BudgetFigures as BudgetFigures
from ccd_casadi.budget.evaluation import SourceFigures as SourceFigures
from ccd_casadi.budget.evaluation import evaluate_budget as evaluate_budget
from ccd_casadi.budget.sources import ErrorBudget as ErrorBudget
from ccd_casadi.budget.sources import ErrorSource as ErrorSource
from ccd_casadi.budget.sources import ShapedSpectrum as ShapedSpectrum
from ccd_casadi.budget.sources import SourceKind as SourceKind
from ccd_casadi.budget.sources import TabulatedSpectrum as TabulatedSpectrum
