#include "motor.h"

#include "hal.h"

/* Speeds are counts per tick and lengths counts, both times 256. */
#define PER_TICK(speed) ((speed) * 32 / 125)
#define ACCELERATION ((int32_t)(MOTOR_ACCELERATION * 32 / 125000))
#define BRAKING(v) ((v) / 2 * ((v) + ACCELERATION) / ACCELERATION)

static enum motor_phase phase;
static bool homed;
static int32_t reference; /* encoder at count 0 */
static int32_t wanted;    /* encoder where the motor should be */
static uint8_t fraction;  /* of a count, beyond wanted */
static int32_t target;    /* encoder */
static int32_t speed, top_speed;

void motor_init(void)
{
    phase = MOTOR_IDLE;
    homed = false;
    reference = hal_motor_counts();
    speed = 0;
}

static void begin(enum motor_phase next, int32_t to, int32_t counts_per_s)
{
    phase = next;
    target = to;
    wanted = hal_motor_counts();
    fraction = 0;
    speed = 0;
    top_speed = PER_TICK(counts_per_s);
    if (top_speed < 1)
        top_speed = 1;
}

void motor_home(void)
{
    homed = false;
    begin(MOTOR_HOMING_DOWN, hal_motor_counts() - 2 * MOTOR_FARTHEST, MOTOR_HOMING_SPEED);
}

void motor_move(int32_t to, uint32_t counts_per_s)
{
    if (counts_per_s == 0 || counts_per_s > MOTOR_MAX_SPEED)
        counts_per_s = MOTOR_MAX_SPEED;
    begin(MOTOR_MOVING, to + reference, (int32_t)counts_per_s);
}

void motor_stop(void)
{
    if (phase != MOTOR_IDLE)
        phase = MOTOR_STOPPING;
}

static void halt(void)
{
    phase = MOTOR_IDLE;
    speed = 0;
}

static uint32_t square_root(uint32_t value)
{
    uint32_t root = 0;
    for (uint32_t bit = 1UL << 30; bit; bit >>= 2) {
        if (value >= root + bit) {
            value -= root + bit;
            root = (root >> 1) + bit;
        } else {
            root >>= 1;
        }
    }
    return root;
}

/* The speed from which steps that shrink by ACCELERATION end after a distance. */
static int32_t speed_to_stop_in(int32_t distance)
{
    if (distance >= BRAKING(top_speed))
        return top_speed;
    uint32_t a = (uint32_t)ACCELERATION;
    int32_t v = (int32_t)(square_root(a * a + 8 * a * (uint32_t)distance) - a) / 2;
    return v < top_speed ? v : top_speed;
}

static void advance_wanted(void)
{
    bool braking = phase == MOTOR_STOPPING || phase == MOTOR_HOMING_BRAKE;
    int32_t away = target - wanted, distance = 0, goal = 0;
    if (!braking) {
        if (away > MOTOR_FARTHEST)
            away = MOTOR_FARTHEST;
        if (away < -MOTOR_FARTHEST)
            away = -MOTOR_FARTHEST;
        distance = away * 256 - fraction;
        goal = distance < 0 ? -speed_to_stop_in(-distance) : speed_to_stop_in(distance);
    }
    int32_t change = goal - speed;
    if (change > ACCELERATION)
        change = ACCELERATION;
    if (change < -ACCELERATION)
        change = -ACCELERATION;
    speed += change;

    int32_t before = wanted, off = distance - speed;
    if (!braking && off > -128 && off < 128) { /* within half a count */
        wanted = target;
        fraction = 0;
        speed = 0;
    } else {
        int32_t moved = speed + fraction;
        fraction = (uint8_t)(moved & 0xFF);
        wanted += (moved - fraction) / 256;
    }
    hal_motor_step((int16_t)(wanted - before));
}

static enum motor_event next_phase(void)
{
    bool at_switch = hal_switches() & HAL_HOME_CLOSED;
    switch (phase) {
    case MOTOR_HOMING_DOWN:
        if (at_switch)
            phase = MOTOR_HOMING_BRAKE;
        break;
    case MOTOR_HOMING_BRAKE:
        if (speed == 0)
            begin(MOTOR_HOMING_UP, wanted + 2 * MOTOR_FARTHEST, MOTOR_HOMING_SLOW);
        break;
    case MOTOR_HOMING_UP:
        if (!at_switch) {
            reference = hal_motor_counts() - MOTOR_HOME_SWITCH;
            target = reference;
            phase = MOTOR_HOMING_ZERO;
        }
        break;
    case MOTOR_HOMING_ZERO:
    case MOTOR_MOVING:
        if (wanted == target && speed == 0) {
            homed = homed || phase == MOTOR_HOMING_ZERO;
            halt();
            return MOTOR_DONE;
        }
        break;
    case MOTOR_STOPPING:
        if (speed == 0)
            halt();
        break;
    case MOTOR_IDLE:
        break;
    }
    return MOTOR_NOTHING;
}

enum motor_event motor_tick(void)
{
    if (phase == MOTOR_IDLE)
        return MOTOR_NOTHING;
    advance_wanted();
    int32_t behind = wanted - hal_motor_counts();
    if (behind > MOTOR_STALL_COUNTS || behind < -MOTOR_STALL_COUNTS) {
        homed = false;
        halt();
        return MOTOR_STALLED;
    }
    if (hal_switches() & HAL_LIMIT_CLOSED) {
        halt();
        return MOTOR_LIMIT_HIT;
    }
    return next_phase();
}

enum motor_phase motor_phase(void)
{
    return phase;
}

bool motor_homed(void)
{
    return homed;
}

int32_t motor_counts(void)
{
    return hal_motor_counts() - reference;
}
