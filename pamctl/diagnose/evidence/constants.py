"""All numbers that decide in a diagnosis by evidence: meaning, source, and half or twice of each.

"Set" says on what: none is set by a case of its own. One (NUGGET) is set on measured data.
"""

from __future__ import annotations

LEVELS = 9
"""Haar levels of a record at 1 kHz: a block is 2**9 samples, longer than the plant's memory of
60 ms. Half (256 samples): slow effects fall into the block means, nulls get wider intervals."""

LEAST_LEVELS = 7
"""Levels of a slow log (100 Hz): 128 samples, or too few coefficients for a scale."""

NU = 4.0
"""Degrees of freedom of the t-likelihood: the tails of measured residuals. Half: less efficient on
clean rigs. Twice: nearer to Gauss, single stick-slip events decide."""

NUGGET = 0.3
"""No scale is below this share of the channel's whole residual: 0 is one-step prediction error, 1
is simulation error. Set on two seals and a joint. Half: quiet fine levels buy a lost slow one.
Twice: small effects beside large ones are lost."""

FIT_STEPS = 12
"""Gauss-Newton steps at most; a fit that needs twice as many stands on a ridge."""

FIT_STOP = 0.5
"""Nats: a step that gains less ends a fit. Half a parameter's worth."""

SHORTLIST = 6
"""Hypotheses that are refitted in a round. Half loses names; twice doubles the cost."""

KEPT = 25
"""Hypotheses that are asked again after the first round. Half loses small names beside a large."""

MOST_NAMES = 8
"""Hypotheses in one model. It is a wall against endless mending, and no statistic."""

STRETCH = 4
"""Blocks in a piece of the bootstrap: 2 s, longer than the residual's memory."""

DRAWS = 1000
"""Draws of the bootstrap; its 0.5 % quantile is then known to a tenth of its width."""

SURE = 0.005
"""One-sided level of every interval that decides."""

NAME_NATS = 8.0
"""What a new name must gain after leave-out: log of the pool, and 3."""

RIVAL_SHARE = 0.10
"""A rival is beaten if it surely loses this share of what the name gains. Twice: more sets."""

FREER_SHARE = 0.15
"""A freer term of the same place can mimic a name; it speaks against it only if it gains so much
more. Half: true names of another form turn into kinds."""

FIRST_SHARE = 0.3
"""A name is taken before a freer term of its place that gains so much more: the rest is often what
is not in the model yet, and an exchange may put the term back. Half: laws stand for names."""

SEEN_SHARE = 0.05
"""Of the robust mean square of some channel that a name takes off: less no reader can see."""

SMALL_SHARE = 0.25
"""Of its smallest size of interest: what is smaller is not said, however sure."""

NAME_SHARE = 0.1
"""Of the whole gain: what gains less beside the first finding mends the model, and is said to be
that; so is what has no sure place, and takes off less of what the recalibrated model leaves (RMS).
What promises less than this share of the best is not fitted in that round.
Half: the form of a law that is nearly right gets a name of its own."""

LEFT_SHARE = 0.5
"""A name takes off some channel at least this share of what stays unexplained there (RMS over the
sensor's noise). Else something larger is still missing, and only its place is said. What comes
after the first finding takes off twice that share, or it only mends the model."""

LEFT_TIMES = 3.0
"""Times a sensor's noise: a channel that is left at more (RMS) holds something more. Half: noise
that differs between records is called a gap."""

EXCHANGE_SHARE = 0.3
"""Only names whose removal costs less than this share of the whole gain are exchanged."""

COARSE_STEP_S = 1e-3
"""Steps of the simulations that a fit compares; their error is taken from FINE steps."""

LEAST_STEPS = 2
"""Steps in a sample at least. Half: a quick valve is taken for a delay, since no fit finds its
time; four rigs take 78 % of the time."""

SCORE_STEP_S = 1.25e-3
"""Steps of the simulations that only tell which hypotheses are worth a fit; one in a sample at
least."""

FINE_STEP_S = 0.25e-3
"""Steps of the simulation that counts: twice as fine as the simulated rig's."""

MOST_DOSE = 30.0
"""Growth of a dose at once, towards the size of the residual."""

REST_SHARE = 0.03
"""Where a motion is imposed, slower samples than this share of the usual top speed are masked:
a log has no velocity there."""
