#include "lights.h"

#include <string.h>

#include "hal.h"
#include "motor.h"

#define MAX_ON_US 4000000UL
#define MAX_PERIOD_US 60000000UL
#define EDGE_US 1000 /* the last bit before an edge is waited out: a tick or packet takes less */
#define SERVO_START 13000
#define SERVO_PER_TICK 40 /* 4 rad/s */

/* On-time at full level in units of 16 us, so that 32 bits do; refilled at a quarter of time. */
#define UNIT(us) ((us) >> 4)
#define BUDGET UNIT(2000000UL)

enum phase { WAIT, SETTLE, STROBE };

struct step {
    uint8_t panels, flags;
    uint16_t level;
    uint32_t settle_us, strobe_us, period_us;
};

static struct step program[LIGHTS_MAX_STEPS];
static struct lights_record records[LIGHTS_MAX_STEPS];
static uint8_t uploaded, done, open_panels;
static uint16_t gains[PS_PANELS], levels[PS_PANELS];
static uint32_t used[PS_PANELS], updated_us;
static uint32_t strobes, triggers;
static bool running;
static enum phase phase;
static uint32_t due_us, trigger_due_us;
static uint16_t tilt, tilt_target;

void lights_init(void)
{
    memset(gains, 0xFF, sizeof gains);
    memset(levels, 0, sizeof levels);
    hal_panels(levels);
    uploaded = done = open_panels = 0;
    strobes = triggers = 0;
    running = false;
    for (uint8_t i = 0; i < PS_PANELS; i++)
        used[i] = 0;
    updated_us = (uint32_t)hal_time_us();
    tilt = tilt_target = SERVO_START;
    hal_servo(tilt);
}

/* ------------------------------------------------------------------ on-time budget */

static uint32_t at_level(uint32_t units, uint16_t level)
{
    return units * (((uint32_t)level + 3) >> 2) >> 14; /* at most 250000 * 2^14 */
}

static uint32_t less(uint32_t value, uint32_t change)
{
    return value > change ? value - change : 0;
}

static void update_used(void)
{
    uint32_t units = UNIT((uint32_t)hal_time_us() - updated_us);
    if (units > UNIT(MAX_ON_US)) /* panels are off by then */
        units = UNIT(MAX_ON_US);
    updated_us += units << 4;
    for (uint8_t i = 0; i < PS_PANELS; i++)
        used[i] = less(used[i] + at_level(units, levels[i]), units / 4);
}

static uint16_t level_of(const struct step *step, uint8_t panel)
{
    if (!(step->panels >> panel & 1))
        return 0;
    return (uint16_t)((uint32_t)step->level * gains[panel] / 0xFFFF);
}

static bool within_limits(void)
{
    uint32_t would[PS_PANELS];
    update_used();
    memcpy(would, used, sizeof would);
    for (const struct step *step = program; step < program + uploaded; step++) {
        if (step->period_us > MAX_PERIOD_US || step->strobe_us == 0)
            return false;
        bool too_long = step->settle_us > MAX_ON_US || step->strobe_us > MAX_ON_US
                        || step->settle_us + step->strobe_us > MAX_ON_US;
        if (too_long && step->panels)
            return false;
        uint32_t on = too_long ? UNIT(MAX_ON_US) : UNIT(step->settle_us + step->strobe_us);
        uint32_t idle = less(UNIT(step->period_us), on);
        for (uint8_t i = 0; i < PS_PANELS; i++) {
            would[i] = less(would[i] + at_level(on, level_of(step, i)), on / 4);
            if (would[i] > BUDGET)
                return false;
            would[i] = less(would[i], idle / 4);
        }
    }
    return true;
}

/* ------------------------------------------------------------------ program */

void lights_gains(const uint8_t *body)
{
    for (uint8_t i = 0; i < PS_PANELS; i++)
        gains[i] = ps_get16(body + 2 * i);
}

bool lights_upload(const uint8_t *body, uint8_t count)
{
    uint8_t first = *body++;
    if ((first && first != uploaded) || first > LIGHTS_MAX_STEPS - count)
        return false;
    for (uint8_t i = 0; i < count; i++, body += PS_STEP_SIZE)
        program[first + i] = (struct step){
            body[0], body[1], ps_get16(body + 2),
            ps_get32(body + 4), ps_get32(body + 8), ps_get32(body + 12)};
    uploaded = first + count;
    return true;
}

bool lights_start(uint8_t count)
{
    if (count == 0 || count != uploaded || !within_limits())
        return false;
    done = 0;
    running = true;
    phase = WAIT;
    due_us = (uint32_t)hal_time_us() + EDGE_US; /* so that the answer goes out before */
    return true;
}

static void switch_to(const struct step *step)
{
    update_used();
    for (uint8_t i = 0; i < PS_PANELS; i++)
        levels[i] = step ? level_of(step, i) : 0;
    hal_panels(levels);
}

void lights_abort(void)
{
    switch_to(NULL);
    running = false;
}

static void trigger(const struct step *step, uint64_t now)
{
    if (step->flags & 1) {
        hal_trigger();
        triggers++;
    }
    struct lights_record *record = &records[done];
    record->strobe_counter = ++strobes;
    record->trigger_counter = triggers;
    record->time_us = now;
    record->motor_counts = hal_capabilities() & PS_MOTOR ? motor_counts() : PS_NO_MOTOR;
    memcpy(record->levels, levels, sizeof levels);
}

/* Panels are off; the next step, if there is one. */
static enum lights_event end_of_step(const struct step *step, uint32_t now)
{
    struct lights_record *record = &records[done++];
    record->strobe_us = now - (uint32_t)record->time_us;
    if (done == uploaded) {
        running = false;
        return LIGHTS_DONE;
    }
    phase = WAIT;
    /* from when the trigger was due, so that small delays do not add up */
    due_us = trigger_due_us + step->period_us - program[done].settle_us;
    if ((int32_t)(due_us - now) < 0)
        due_us = now;
    return LIGHTS_NOTHING;
}

enum lights_event lights_poll(void)
{
    if (!running || !lights_due_within(EDGE_US))
        return LIGHTS_NOTHING;
    hal_wait_until(due_us);
    const struct step *step = &program[done];
    uint64_t time = hal_time_us();
    uint32_t now = (uint32_t)time;
    if (phase == WAIT) {
        switch_to(step);
        phase = SETTLE;
        due_us += step->settle_us;
    } else if (phase == SETTLE) {
        /* checked now because the current needs the settle time */
        uint8_t lit = 0;
        for (uint8_t i = 0; i < PS_PANELS; i++)
            lit |= (uint8_t)((levels[i] != 0) << i);
        open_panels = lit & (uint8_t)~hal_panel_currents();
        if (open_panels) {
            lights_abort();
            return LIGHTS_OPEN;
        }
        trigger_due_us = due_us;
        trigger(step, time);
        phase = STROBE;
        due_us = now + step->strobe_us;
    } else {
        switch_to(NULL);
        return end_of_step(step, now);
    }
    return LIGHTS_NOTHING;
}

void lights_tick(void)
{
    update_used();
    if (tilt == tilt_target)
        return;
    if (tilt < tilt_target)
        tilt = tilt_target - tilt > SERVO_PER_TICK ? tilt + SERVO_PER_TICK : tilt_target;
    else
        tilt = tilt - tilt_target > SERVO_PER_TICK ? tilt - SERVO_PER_TICK : tilt_target;
    hal_servo(tilt);
}

/* ------------------------------------------------------------------ state */

void lights_tilt(uint16_t units)
{
    tilt_target = units;
}

bool lights_running(void)
{
    return running;
}

bool lights_on(void)
{
    for (uint8_t i = 0; i < PS_PANELS; i++)
        if (levels[i])
            return true;
    return false;
}

bool lights_due_within(uint32_t us)
{
    return running && (int32_t)(due_us - (uint32_t)hal_time_us()) < (int32_t)us;
}

uint8_t lights_open_panels(void)
{
    return open_panels;
}

uint16_t lights_tilt_now(void)
{
    return tilt;
}

uint8_t lights_steps_done(void)
{
    return done;
}

uint32_t lights_strobes(void)
{
    return strobes;
}

uint32_t lights_triggers(void)
{
    return triggers;
}

const struct lights_record *lights_record(uint8_t index)
{
    return index < done ? &records[index] : NULL;
}
