"""Why bounds are withdrawn, what remarks a store makes on them, and when they expire: texts with places for numbers.

Those of a withdrawal say what is wrong and what would help.
"""

AUDIT = "`ctxval certify --audit N` bounds the share of the tasks that exceed a threshold"

# Learned dynamics

FEW_EXECUTIONS = (
    "the dynamics are learned from {executions} executed trajectories, and the bound needs at least {fewest}; execute "
    "more tasks"
)
NOT_PLANNED = (
    "for {percent:.2g} % of the tasks no controller can be designed, or the model diverges: nothing is known there; "
    "make the task space smaller, so that every task can be executed"
)
FEW_PREDICTIONS = (
    "{checked} executions of different tasks were predicted from earlier ones, and the bound needs {needed} "
    "predictions that hold; execute more tasks"
)
NOISY = (
    "noise is learned with {percent:.2g} % of the variance of the residual, and at most {most:g} % is allowed: the "
    "system is not deterministic in the recorded state and input; record more states or reduce the noise, or use "
    "--kind posterior"
)
NOISE_CONTRADICTED = (
    "the last executions contradict the learned noise (evidence {against:.0f}, and at most {most:g} is allowed): it "
    "may be correlated, rare, or larger in some tasks, or a state that is not recorded acts; execute more tasks, or "
    "record more states"
)
UNEXPLAINED = (
    "trial {trial} has the distance {distance:.4g}, and {expected:.4g} on the dynamics that all executions teach: they "
    "do not explain it, because they depend on the task, on time or on a state that is not recorded; record more states"
)
CONTRADICTED = (
    "the noise that all executions teach does not explain all of them (evidence {against:.3g}, and at most {most:g} is "
    "allowed): the distance of trial {trial} has a probability of {p:.2g}; an execution of its task again helps "
    "(`ctxval run` executes it)"
)
EXECUTED_ONCE = (
    "the learned dynamics depend most on a task that was executed once, so a property of this execution may be taken "
    "for one of the task; an execution of it again helps (`ctxval run` executes it)"
)
DRIFT = (
    "executions differ by effects that change with {cause} (p-value {p:.2g}), and the learned noise assumes that they "
    "do not; find the cause, or state a parameter that changes the dynamics (physical = [...])"
)
UNEVEN = (
    "a joint at rest withstood {times:.2g} times a force that moved it elsewhere: friction at rest is not the same "
    "everywhere or at any time, and its largest value is not known; use --kind posterior or an audit"
)
UNTESTED_REST = (
    "no execution left rest under a small force within {length} around {place}: if friction at rest is {times:g} times "
    "as large there, distances of {highest:.4g} are predicted; an execution that starts there under a small force "
    "helps (`ctxval run` executes it)"
)
UNSUPPORTED = (
    "{above} of {executions} executions exceed {level:.4g}, more than the learned noise explains (the likelihood "
    "ratio of this noise against a share of {share:.3g} % above it is {ratio:.2g}, and at least 1 is needed); further "
    "executions of these tasks help (`ctxval run` executes them)"
)
LEFT_OUT = (
    "the posterior samples of the dynamics understate the predictive uncertainty: they lack {percent:.0f} % of the "
    "largest posterior variance, and at most {most:g} % is allowed; more executions reduce it"
)
GAP_AT = "{coordinates} by {percent:.2g} % (at {place}); `ctxval run` executes a task that goes there"
BEYOND = f"predicted runs leave the recorded range of {GAP_AT}"
DIVERGED = (
    "predicted runs diverge: they leave the records by more than ten times the range that most of them visit, so "
    "too little is learned to predict them; execute smaller tasks first, and be ready to stop the system"
)
GAP = f"predicted runs enter a gap in the records of {GAP_AT}"
PAIR_GAP = f"predicted runs enter a gap in the joint records of {GAP_AT}"
UNTRIED = (
    "the parameter {name} hardly changes the closed loops of the model, so what it changes in the system cannot be "
    "learned from states and inputs, and some of its values are {percent:.0f} % of its range away from every executed "
    "one; an execution there helps (`ctxval run` executes it)"
)
UNTRIED_CORNER = (
    "no execution has a task near the corner {place}, and what stands in a corner, such as a post or a wall, would go "
    "unnoticed; an execution there helps (`ctxval run` executes it)"
)
POCKET = (
    "no execution came within {within} of {place}, where predicted runs lead, and a post, a hole or a current there "
    "would go unnoticed; an execution that leads there helps (`ctxval run` executes it)"
)
NOT_TESTED = (
    "the largest distance is predicted to be {highest:.4g}, but the largest executed one is {best:.4g}: the prediction "
    "is not tested where it matters; an execution of that task helps (`ctxval run` executes it)"
)
NONE_HELD = (
    "no prediction held at a distance of at least {percent:g} % of the {what}: small distances hardly test it; an "
    "execution of another task with a large distance helps (`ctxval run` executes it)"
)
TESTS_MISSING = (
    "at least {missing} more {executions} must be predicted beforehand, at tasks drawn over the whole task space "
    "(`ctxval run` executes them)"
)
NEEDLE = (
    "one of the largest predicted distances falls by {percent:.0f} % if a task changes by a thousandth of its ranges, "
    "so a search may miss the largest distance: the controllers change abruptly from task to task, as those of a model "
    "with kinks do, or the closed loop does; use a smoother model, or an audit"
)
JUMP = (
    "the predicted distance jumps by up to {percent:.2g} % of the bound if a task changes by a thousandth of its "
    "ranges, so a search may miss the largest distance: the controllers change abruptly from task to task, as those of "
    "a model with kinks do, or the closed loop does; use a smoother model, or an audit"
)
SEARCHES_DIFFER = (
    "searches of the learned dynamics find largest distances that differ by {percent:.0f} %, because the controllers "
    "or the closed loop change abruptly from task to task; an execution of the task of the largest one helps (`ctxval "
    "run` executes it), or use a smoother model, or an audit"
)

# The posterior of the distance

SURPRISING = (
    "trial {trial} came out {deviations:.1f} standard deviations above what the {others} predict: the distance is not "
    "as smooth as the bound assumes, so the bound is withdrawn"
)
FAR_TASK = (
    "some task is {farthest:.2g} of the task space's diagonal away from every trial, more than the resolution of "
    "{resolution:g}, so the bound is withdrawn; {many} more executions would come near to every task (`ctxval run` "
    f"makes them), or {AUDIT}"
)
BARE_CORNERS = (
    "no trial is at or next to {bare} of the {corners} {where}, towards which the distance may rise unseen, so the "
    "bound is withdrawn; {bare} more executions would be there (`ctxval run` makes them)"
)

# Remarks on later changes of a store

ACCEPTED = "what was changed after {trials} trials makes no difference to them: {why!r} ({differences})"
MEASURED_ANEW = "the distances are those measured anew: {why!r}"
REPLACED = "the result of trial {numbers} that was told first is wrong: {why!r}"
SET_ASIDE = "the trial that could not be read would not change this: {why}"
REFINED = (
    "the model was learned again from executions of earlier models: these are data of the model and no trials of it, "
    "so only executions under its own controllers are counted"
)

# Whether a certificate still holds

EXCEEDED = "expired: run {run} has the distance {distance:.4g}, above the threshold {threshold:g}"
CHANGED = "expired: {cause} since run {since} are {times} times those certified"
HOLDS = "holds: {agree} with the certified ones (evidence of a change {evidence:.2g}, alarm at {limit:.4g})"
SUSPECTED = (
    "holds so far: {cause} since run {since} are {times} times those certified, which is too little evidence for an "
    "alarm (evidence of a change {evidence:.2g}, alarm at {limit:.4g}); judge further runs"
)
