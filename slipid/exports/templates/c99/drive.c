/* Control loop for a robot whose readings come as text: first the start pose, then a line with dt
   and the sensors' readings for each step; nan stands for a reading that is absent. Each output line
   has the wheel speeds [rad/s] and the time of the path [s]. */
#include <stdio.h>

#include "slipid.h"

#ifndef DIGITS
#define DIGITS 9 /* decimal places; use 15 to close a loop with a plant */
#endif

static int numbers(slipid_real *into, int count) {
  double value;
  for (int k = 0; k < count; ++k) {
    if (scanf("%lf", &value) != 1) {
      return 0;
    }
    into[k] = (slipid_real)value;
  }
  return 1;
}

int main(void) {
  static slipid_state state;
  slipid_reading in;
  slipid_estimate estimate;
  slipid_real pose[3], reference[6], command[SLIPID_DRIVES], dt;
  if (!numbers(pose, 3)) {
    return 1;
  }
  slipid_init(&state, pose);
  while (numbers(&dt, 1) && numbers(in.wheel_angle, SLIPID_DRIVES) &&
         numbers(in.wheel_speed, SLIPID_DRIVES) && numbers(in.current, SLIPID_DRIVES) &&
         numbers(in.voltage, SLIPID_DRIVES) && numbers(&in.gyro, 1) && numbers(in.fix, 3) &&
         numbers(in.fix_std, 2) && numbers(&in.fix_age, 1)) {
    slipid_observe(&state.estimator, &in, dt, &estimate);
    slipid_follow(&state.time, estimate.pose, dt, reference);
    slipid_command(&state.controller, reference, &estimate, dt, command);
    for (int k = 0; k < SLIPID_DRIVES; ++k) {
      printf("%.*f ", DIGITS, (double)command[k]);
    }
    printf("%.*f\n", DIGITS, (double)state.time);
    fflush(stdout);
  }
  return 0;
}
