/* One control step every 50 ms. Fill in how your robot reads its sensors and drives its wheels.
   A step keeps @STACK@ of intermediate numbers on the stack, half as much with SLIPID_FLOAT: make sure that
   the task of loop() has a stack of that size. */
#include <slipid.h>

static slipid_state state;
static slipid_reading reading;
static slipid_estimate estimate;
static slipid_real command[SLIPID_DRIVES];
static unsigned long last_ms;

void setup() {
  const slipid_real start[3] = {0, 0, 0};
  slipid_init(&state, start);
  last_ms = millis();
}

void loop() {
  const unsigned long now_ms = millis();
  if (now_ms - last_ms < 50) {
    return;
  }
  const slipid_real dt = (slipid_real)(now_ms - last_ms) / 1000;
  last_ms = now_ms;
  const slipid_real reference[6] = {0, 0, 0, 0, 0, 0}; /* pose and rates that the robot should have */
  slipid_nothing(&reading);
  /* reading.wheel_angle[0] = ...; reading.current[0] = ...; */
  slipid_step(&state, &reading, reference, dt, &estimate, command);
  /* drive the wheels with command[0] ... [rad/s] */
}
