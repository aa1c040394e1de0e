@HEAD@
#include "slipid.h"

#include <float.h>
#include <math.h>

@PRELUDE@
@TABLES@

void slipid_init(slipid_state *state, const slipid_real pose[3]) {
  slipid_begin(&state->estimator, &state->controller, pose);
  state->time = R(0.0);
}

void slipid_step(slipid_state *state, const slipid_reading *reading, const slipid_real reference[6],
                 slipid_real dt, slipid_estimate *estimate, slipid_real command[SLIPID_WHEELS]) {
  slipid_observe(&state->estimator, reading, dt, estimate);
  slipid_command(&state->controller, reference, estimate, dt, command);
}

@FUNCTIONS@
