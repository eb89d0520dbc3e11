/* Motor: homing, moves within speed and acceleration, stall and limit. Called every millisecond. */
#ifndef PS_MOTOR_H
#define PS_MOTOR_H

#include <stdbool.h>
#include <stdint.h>

#define MOTOR_TICK_US 1000
#define MOTOR_FARTHEST (1L << 22) /* largest soft limit, counts */

enum motor_phase {
    MOTOR_IDLE,
    MOTOR_MOVING,
    MOTOR_HOMING_DOWN,  /* towards the switch */
    MOTOR_HOMING_BRAKE, /* on the switch, slowing down */
    MOTOR_HOMING_UP,    /* slowly off it: the edge is the reference */
    MOTOR_HOMING_ZERO,  /* up to count 0 */
    MOTOR_STOPPING
};

enum motor_event { MOTOR_NOTHING, MOTOR_DONE, MOTOR_STALLED, MOTOR_LIMIT_HIT };

void motor_init(void);
void motor_home(void);
void motor_move(int32_t target, uint32_t speed); /* counts, counts/s; 0: the fastest */
void motor_stop(void);
enum motor_event motor_tick(void);

enum motor_phase motor_phase(void);
bool motor_homed(void);
int32_t motor_counts(void);

#endif
