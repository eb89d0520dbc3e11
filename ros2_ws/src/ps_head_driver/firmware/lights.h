/* Panels: strobe programs at exact times, on-time budget, dark-field servo. */
#ifndef PS_LIGHTS_H
#define PS_LIGHTS_H

#include <stdbool.h>
#include <stdint.h>

#include "protocol.h"

#define LIGHTS_MAX_STEPS 32

struct lights_record {
    uint32_t strobe_counter, trigger_counter;
    uint64_t time_us;
    uint32_t strobe_us;
    int32_t motor_counts;
    uint16_t levels[PS_PANELS];
};

enum lights_event { LIGHTS_NOTHING, LIGHTS_DONE, LIGHTS_OPEN };

void lights_init(void);
void lights_gains(const uint8_t *body);
void lights_tilt(uint16_t units);
bool lights_upload(const uint8_t *body, uint8_t count); /* a STEPS body; false: does not fit */
bool lights_start(uint8_t count);                       /* false: incomplete or beyond limits */
void lights_abort(void);
enum lights_event lights_poll(void);
void lights_tick(void); /* every millisecond: on-time budget, servo */

bool lights_running(void);
bool lights_on(void);
bool lights_due_within(uint32_t us); /* whether the next edge is near */
uint8_t lights_open_panels(void);    /* mask, after LIGHTS_OPEN */
uint16_t lights_tilt_now(void);
uint8_t lights_steps_done(void);
uint32_t lights_strobes(void);
uint32_t lights_triggers(void);
const struct lights_record *lights_record(uint8_t index);

#endif
