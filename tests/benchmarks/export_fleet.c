/* Many robots at once that follow the path of the generated code, for numpy. */
#include "slipid.h"

int32_t fleet_state_size(void);
void fleet_init(int32_t count, slipid_state *state);
void fleet_drive(int32_t count, slipid_real dt, slipid_state *state, const slipid_reading *reading,
                 slipid_estimate *estimate, slipid_real *reference, slipid_real *command);

int32_t fleet_state_size(void) {
  return (int32_t)sizeof(slipid_state);
}

void fleet_init(int32_t count, slipid_state *state) {
  const slipid_real pose[3] = {0, 0, 0};
  for (int32_t k = 0; k < count; ++k) {
    slipid_init(&state[k], pose);
  }
}

void fleet_drive(int32_t count, slipid_real dt, slipid_state *state, const slipid_reading *reading,
                 slipid_estimate *estimate, slipid_real *reference, slipid_real *command) {
  for (int32_t k = 0; k < count; ++k) {
    slipid_observe(&state[k].estimator, &reading[k], dt, &estimate[k]);
    slipid_follow(&state[k].time, estimate[k].pose, dt, &reference[6 * k]);
    slipid_command(&state[k].controller, &reference[6 * k], &estimate[k], dt,
                   &command[SLIPID_WHEELS * k]);
  }
}
