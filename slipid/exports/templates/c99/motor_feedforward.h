/*
@HEAD@
 */
#ifndef MOTOR_FEEDFORWARD_H
#define MOTOR_FEEDFORWARD_H
@BODY@
#endif
