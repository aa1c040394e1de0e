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
                 slipid_real dt, slipid_estimate *estimate, slipid_real command[SLIPID_DRIVES]) {
  slipid_observe(&state->estimator, reading, dt, estimate);
  slipid_command(&state->controller, reference, estimate, dt, command);
}

void slipid_drive(slipid_state *state, const slipid_reading *reading, const slipid_real twist[3],
                  slipid_real dt, slipid_estimate *estimate, slipid_real command[SLIPID_DRIVES]) {
  slipid_observe(&state->estimator, reading, dt, estimate);
  slipid_move(&state->controller, twist, estimate, dt, command);
}

void slipid_command(slipid_controller *controller, const slipid_real reference[6],
                    const slipid_estimate *estimate, slipid_real dt, slipid_real command[SLIPID_DRIVES]) {
  slipid_real twist[3];
  slipid_asked(controller, reference, estimate, dt, twist);
  slipid_move(controller, twist, estimate, dt, command);
}

@FUNCTIONS@
