#include "head.h"

#include <string.h>

#include "hal.h"
#include "lights.h"
#include "motor.h"
#include "protocol.h"

#define WATCHDOG_US 350000UL
#define HOT 35300 /* 0.01 K */
#define MAX_TILT 31416
#define QUIET_US 2000 /* no packet is worked on this near to an edge of a strobe */

static struct ps_decoder decoder;
static struct ps_packet request, reply;
static uint8_t reply_wire[PS_MAX_WIRE], reply_length; /* 0: nothing to repeat */
static uint8_t last_sequence;
static uint16_t last_crc;
static uint16_t session;
static uint32_t heard_us, ticked_us;
static int32_t low_limit, high_limit;
static uint8_t end;
static uint16_t faults;
static uint8_t fault_panels, panel_to_check;

void head_init(void)
{
    memset(&decoder, 0, sizeof decoder);
    session = 0;
    reply_length = 0;
    low_limit = high_limit = 0;
    end = PS_END_NONE;
    faults = 0;
    fault_panels = 0;
    heard_us = ticked_us = (uint32_t)hal_time_us();
    motor_init();
    lights_init();
}

/* ------------------------------------------------------------------ activity */

static uint8_t activity(void)
{
    if (lights_running())
        return PS_STROBING;
    switch (motor_phase()) {
    case MOTOR_IDLE:
        return PS_IDLE;
    case MOTOR_MOVING:
        return PS_MOVING;
    case MOTOR_STOPPING:
        return PS_STOPPING;
    default:
        return PS_HOMING;
    }
}

static void stop_all(uint8_t how)
{
    if (activity() != PS_IDLE)
        end = how;
    lights_abort();
    motor_stop();
}

static void fail(uint16_t fault, uint8_t panels)
{
    faults |= fault;
    fault_panels |= panels;
    stop_all(PS_END_FAULT);
}

static uint8_t hot_panels(void)
{
    uint8_t mask = 0;
    for (uint8_t i = 0; i < PS_PANELS; i++)
        mask |= (uint8_t)((hal_temperature(i) > HOT) << i);
    return mask;
}

static void tick(void)
{
    enum motor_event event = motor_tick();
    if (event == MOTOR_DONE)
        end = PS_END_DONE;
    if (event == MOTOR_STALLED || event == MOTOR_LIMIT_HIT) {
        end = PS_END_FAULT;
        fail(event == MOTOR_STALLED ? PS_STALL : PS_LIMIT, 0);
    }
    if (hal_capabilities() & PS_LIGHTS) {
        lights_tick();
        panel_to_check = (uint8_t)(panel_to_check + 1) % PS_PANELS; /* each one every 8 ms */
        if (hal_temperature(panel_to_check) > HOT)
            fail(PS_OVER_TEMPERATURE, (uint8_t)(1 << panel_to_check));
    }
    uint8_t doing = activity();
    if (doing != PS_IDLE && doing != PS_STOPPING
        && (uint32_t)hal_time_us() - heard_us >= WATCHDOG_US)
        fail(PS_WATCHDOG, 0);
}

/* ------------------------------------------------------------------ commands */

static void say_hello(void)
{
    const char *serial = hal_serial();
    ps_put8(&reply, PS_VERSION);
    ps_put8(&reply, 0); /* firmware 0.1.0 */
    ps_put8(&reply, 1);
    ps_put8(&reply, 0);
    ps_put8(&reply, hal_capabilities());
    ps_put8(&reply, LIGHTS_MAX_STEPS);
    for (uint8_t i = 0; i < 16; i++)
        ps_put8(&reply, (uint8_t)(*serial ? *serial++ : 0));
}

static enum ps_result hello(void)
{
    if (request.length != 1 || request.session == 0)
        return PS_BAD_LENGTH;
    if (request.session != session) /* a new host finds everything off */
        stop_all(PS_END_STOPPED);
    session = request.session;
    heard_us = (uint32_t)hal_time_us();
    say_hello();
    return request.body[0] == PS_VERSION ? PS_OK : PS_WRONG_VERSION;
}

static void say_status(void)
{
    bool motor = hal_capabilities() & PS_MOTOR, lights = hal_capabilities() & PS_LIGHTS;
    uint8_t flags = 0;
    if (motor && motor_homed())
        flags |= PS_HOMED;
    if (motor && hal_switches() & HAL_HOME_CLOSED)
        flags |= PS_HOME_SWITCH;
    if (lights_on())
        flags |= PS_PANELS_ON;
    ps_put8(&reply, activity());
    ps_put8(&reply, end);
    ps_put8(&reply, flags);
    ps_put16(&reply, faults);
    ps_put8(&reply, fault_panels);
    ps_put32(&reply, (uint32_t)(motor ? motor_counts() : PS_NO_MOTOR));
    ps_put16(&reply, lights ? lights_tilt_now() : PS_NOT_MEASURED);
    ps_put8(&reply, lights_steps_done());
    ps_put32(&reply, lights_strobes());
    ps_put32(&reply, lights_triggers());
    ps_put64(&reply, hal_time_us());
    for (uint8_t i = 0; i < PS_PANELS; i++)
        ps_put16(&reply, lights ? hal_temperature(i) : PS_NOT_MEASURED);
}

static enum ps_result say_record(uint8_t index)
{
    const struct lights_record *record = lights_record(index);
    if (!record)
        return PS_BAD_VALUE;
    ps_put8(&reply, index);
    ps_put32(&reply, record->strobe_counter);
    ps_put32(&reply, record->trigger_counter);
    ps_put64(&reply, record->time_us);
    ps_put32(&reply, record->strobe_us);
    ps_put32(&reply, (uint32_t)record->motor_counts);
    for (uint8_t i = 0; i < PS_PANELS; i++)
        ps_put16(&reply, record->levels[i]);
    return PS_OK;
}

static enum ps_result set_limits(int32_t low, int32_t high)
{
    if (low >= high || low < -MOTOR_FARTHEST || high > MOTOR_FARTHEST)
        return PS_BAD_VALUE;
    low_limit = low;
    high_limit = high;
    return PS_OK;
}

static enum ps_result move(int32_t target, uint32_t speed)
{
    if (!motor_homed())
        return PS_NOT_HOMED;
    if (target < low_limit || target > high_limit)
        return PS_OUT_OF_LIMITS;
    end = PS_END_NONE;
    motor_move(target, speed);
    return PS_OK;
}

static enum ps_result home(void)
{
    end = PS_END_NONE;
    motor_home();
    return PS_OK;
}

static enum ps_result set_tilt(uint16_t tilt)
{
    if (tilt > MAX_TILT)
        return PS_BAD_VALUE;
    lights_tilt(tilt);
    return PS_OK;
}

static enum ps_result start(uint8_t steps)
{
    if (!lights_start(steps))
        return PS_REJECTED;
    end = PS_END_NONE;
    return PS_OK;
}

static void clear_fault(void)
{
    fault_panels = hal_capabilities() & PS_LIGHTS ? hot_panels() : 0;
    faults = fault_panels ? faults & PS_OVER_TEMPERATURE : 0;
}

/* What a command needs before it is looked at; the order is that of enum ps_command. */
static const struct rule {
    uint8_t length, capability;
    bool only_idle, not_in_fault;
} rules[] = {
    [PS_STATUS] = {0, 0, false, false},
    [PS_LIMITS] = {8, PS_MOTOR, true, false},
    [PS_HOME] = {0, PS_MOTOR, true, true},
    [PS_MOVE] = {8, PS_MOTOR, true, true},
    [PS_STOP] = {0, 0, false, false},
    [PS_SERVO] = {2, PS_LIGHTS, true, false},
    [PS_GAINS] = {16, PS_LIGHTS, true, false},
    [PS_STEPS] = {0, PS_LIGHTS, true, false}, /* its length is checked with its content */
    [PS_START] = {1, PS_LIGHTS, true, true},
    [PS_RECORD] = {1, PS_LIGHTS, false, false},
    [PS_CLEAR_FAULT] = {0, 0, false, false},
};

static bool length_fits(const struct rule *rule)
{
    if (request.type != PS_STEPS)
        return request.length == rule->length;
    return request.length > 1 && (request.length - 1) % PS_STEP_SIZE == 0;
}

static enum ps_result execute(void)
{
    const uint8_t *body = request.body;
    if (request.type < PS_STATUS || request.type > PS_CLEAR_FAULT)
        return PS_UNKNOWN_COMMAND;
    const struct rule *rule = &rules[request.type];
    if (!length_fits(rule))
        return PS_BAD_LENGTH;
    if (rule->capability & (uint8_t)~hal_capabilities())
        return PS_UNSUPPORTED;
    if (rule->only_idle && activity() != PS_IDLE)
        return PS_BUSY;
    if (rule->not_in_fault && faults)
        return PS_FAULT;

    switch (request.type) {
    case PS_STATUS:
        say_status();
        return PS_OK;
    case PS_LIMITS:
        return set_limits((int32_t)ps_get32(body), (int32_t)ps_get32(body + 4));
    case PS_HOME:
        return home();
    case PS_MOVE:
        return move((int32_t)ps_get32(body), ps_get32(body + 4));
    case PS_STOP:
        stop_all(PS_END_STOPPED);
        return PS_OK;
    case PS_SERVO:
        return set_tilt(ps_get16(body));
    case PS_GAINS:
        lights_gains(body);
        return PS_OK;
    case PS_STEPS:
        return lights_upload(body, request.length / PS_STEP_SIZE) ? PS_OK : PS_REJECTED;
    case PS_START:
        return start(body[0]);
    case PS_RECORD:
        return say_record(body[0]);
    default:
        clear_fault();
        return PS_OK;
    }
}

/* ------------------------------------------------------------------ packets */

static void answer(void)
{
    if (request.type & PS_REPLY) /* an echo; never answered */
        return;
    reply.type = request.type | PS_REPLY;
    reply.sequence = request.sequence;
    reply.session = request.session;
    reply.length = 1; /* the result, filled in below */
    enum ps_result result = PS_WRONG_SESSION;
    if (request.type == PS_HELLO) {
        result = hello();
    } else if (session != 0 && request.session == session) {
        heard_us = (uint32_t)hal_time_us();
        if (reply_length && request.sequence == last_sequence && request.crc == last_crc) {
            hal_write(reply_wire, reply_length); /* a retry: say it again, do not do it again */
            return;
        }
        result = execute();
    }
    reply.body[0] = result;
    uint8_t wire[PS_MAX_WIRE];
    uint8_t length = ps_encode(&reply, wire);
    hal_write(wire, length);
    if (result != PS_WRONG_SESSION) {
        memcpy(reply_wire, wire, length);
        reply_length = length;
        last_sequence = request.sequence;
        last_crc = request.crc;
    }
}

void head_poll(void)
{
    enum lights_event event = lights_poll();
    if (event == LIGHTS_DONE)
        end = PS_END_DONE;
    if (event == LIGHTS_OPEN) {
        end = PS_END_FAULT;
        fail(PS_LED_OPEN, lights_open_panels());
    }
    if ((uint32_t)hal_time_us() - ticked_us >= MOTOR_TICK_US) {
        ticked_us += MOTOR_TICK_US;
        tick();
    }
    int byte;
    while (!lights_due_within(QUIET_US) && (byte = hal_read()) >= 0)
        if (ps_decode(&decoder, (uint8_t)byte, &request))
            answer();
}
