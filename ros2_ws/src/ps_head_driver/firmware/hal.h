/* What the head needs of a board. board_avr.c and host/board_host.c implement it. */
#ifndef PS_HAL_H
#define PS_HAL_H

#include <stdint.h>

#include "protocol.h"

/* Motor, in counts and seconds; a board may override them on the compiler's command line. */
#ifndef MOTOR_MAX_SPEED
#define MOTOR_MAX_SPEED 20000L
#endif
#ifndef MOTOR_ACCELERATION
#define MOTOR_ACCELERATION 400000L
#endif
#define MOTOR_HOMING_SPEED 20000L
#define MOTOR_HOMING_SLOW 8000L
#define MOTOR_HOME_SWITCH (-1000L) /* where the home switch opens */
#define MOTOR_STALL_COUNTS 600L    /* between wanted and measured position */

enum hal_switch { HAL_HOME_CLOSED = 1, HAL_LIMIT_CLOSED = 2 };

uint8_t hal_capabilities(void); /* enum ps_capability */
const char *hal_serial(void);   /* at most 16 characters */

uint64_t hal_time_us(void);           /* since power-up */
void hal_wait_until(uint32_t time_us); /* at most 1 ms; low half of hal_time_us */

int hal_read(void); /* next byte from the host, -1 if there is none */
void hal_write(const uint8_t *data, uint8_t length);

void hal_motor_step(int16_t counts);  /* drive this far within the next millisecond */
int32_t hal_motor_counts(void);       /* encoder, from power-up */
uint8_t hal_switches(void);           /* enum hal_switch */

void hal_panels(const uint16_t levels[PS_PANELS]); /* FFFF is full */
uint8_t hal_panel_currents(void);                  /* mask of the panels that draw current */
void hal_trigger(void);                            /* a pulse to the camera */
uint16_t hal_temperature(uint8_t panel);           /* 0.01 K */
void hal_servo(uint16_t tilt);                     /* 0.0001 rad */

#endif
