@HEAD@
#ifndef SLIPID_H
#define SLIPID_H

#include <stdbool.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Define SLIPID_FLOAT for the whole build to use 32-bit numbers. */
#ifdef SLIPID_FLOAT
typedef float slipid_real;
/* Other names for float, so that parts compiled for float and for double cannot be linked together. */
#define slipid_init slipid_init_float
#define slipid_step slipid_step_float
#define slipid_begin slipid_begin_float
#define slipid_nothing slipid_nothing_float
#define slipid_observe slipid_observe_float
#define slipid_command slipid_command_float
#define slipid_drive slipid_drive_float
#define slipid_asked slipid_asked_float
#define slipid_move slipid_move_float
#define slipid_rearm slipid_rearm_float
#define slipid_follow slipid_follow_float
#else
typedef double slipid_real;
#endif

/* Hash of the robot's parameters, the value of `numbers` in robot.json. */
#define SLIPID_ROBOT "@ROBOT@"
@DEFINES@

@ABOUT@

/* State of the estimator. */
@ESTIMATOR@

/* State of the controller. Outputs among its members: drives_off (wheels do not follow their commands,
   as after an emergency stop; they are commanded a small speed until they follow) and gave_up (the
   robot was stuck and has stopped; see slipid_rearm). */
@CONTROLLER@

/* Readings of the sensors; NaN for absent readings. */
@READING@

/* Output of the estimator. */
@ESTIMATE@

/* State of the whole control loop between two steps. */
typedef struct {
  slipid_estimator estimator;
  slipid_controller controller;
  slipid_real time; /* time of the path that slipid_follow follows [s] */
} slipid_state;

/* Set a state to that of a robot at rest at a pose: x, y [m], heading [rad]. */
void slipid_init(slipid_state *state, const slipid_real pose[3]);

/* Compute one control step, a time dt [s] after the last one, to follow a reference: slipid_observe,
   then slipid_command. */
void slipid_step(slipid_state *state, const slipid_reading *reading, const slipid_real reference[6],
                 slipid_real dt, slipid_estimate *estimate, slipid_real command[SLIPID_DRIVES]);

/* The same to drive with a velocity of the body, such as a cmd_vel of ROS: ahead, to the left [m/s], yaw
   rate [rad/s]. The commands compensate the slip that is expected. */
void slipid_drive(slipid_state *state, const slipid_reading *reading, const slipid_real twist[3],
                  slipid_real dt, slipid_estimate *estimate, slipid_real command[SLIPID_DRIVES]);

/* Set the states of estimator and controller for a robot at rest at a pose: x, y [m], heading [rad]. */
@BEGIN@

/* Set all readings to NaN; then fill in the readings of your sensors. */
@NOTHING@

/* Step of the estimator: process readings a time dt [s] after the last call. */
@OBSERVE@

/* Step of the controller: compute wheel speeds to command [rad/s] for a reference, which is x, y [m],
   heading [rad] and their rates in the world [m/s, m/s, rad/s]: slipid_asked, then slipid_move. */
void slipid_command(slipid_controller *controller, const slipid_real reference[6],
                    const slipid_estimate *estimate, slipid_real dt, slipid_real command[SLIPID_DRIVES]);

/* Compute the velocity of the body that follows a reference: ahead, to the left [m/s], yaw rate [rad/s]. */
@ASKED@

/* Compute wheel speeds to command [rad/s] for a velocity of the body. */
@MOVE@

/* Let a robot that gave up drive again; a demand of no motion for a second does the same. */
@REARM@

@FOLLOWABOUT@
@FOLLOW@

#ifdef __cplusplus
}
#endif
#endif
