#include "board_host.h"

#include <string.h>
#include <time.h>

#include "hal.h"
#include "head.h"

#define HARD_LOW (-1600)
#define HARD_HIGH 66000
#define STEP_US 100 /* of the virtual clock */

struct host host;
static int32_t encoder;
static uint64_t power_up_us;

static uint64_t real_us(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000u + (uint64_t)now.tv_nsec / 1000u;
}

void host_power_up(uint8_t capabilities, int32_t position)
{
    bool real_time = host.real_time;
    memset(&host, 0, sizeof host);
    host.real_time = real_time;
    host.capabilities = capabilities;
    host.position = position;
    power_up_us = real_us();
    encoder = 0;
    head_init();
}

void host_advance(uint64_t until_us)
{
    while (host.time_us < until_us) {
        uint64_t next = host.time_us + STEP_US;
        host.time_us = next < until_us ? next : until_us;
        head_poll();
    }
}

uint32_t host_receive(const uint8_t *data, uint32_t length)
{
    host.output_length = 0;
    while (length) {
        uint32_t part = length < HOST_BUFFER ? length : HOST_BUFFER;
        memcpy(host.input, data, part);
        host.input_length = part;
        host.input_read = 0;
        data += part;
        length -= part;
        /* a board near the edge of a strobe reads a little later */
        while (host.input_read < host.input_length)
            host_advance(host.time_us + (host.input_read ? STEP_US : 1));
    }
    return host.output_length;
}

uint8_t hal_capabilities(void)
{
    return host.capabilities;
}

const char *hal_serial(void)
{
    return "FIRMWARE-HOST";
}

uint64_t hal_time_us(void)
{
    return host.real_time ? real_us() - power_up_us : host.time_us;
}

void hal_wait_until(uint32_t time_us)
{
    int32_t left = (int32_t)(time_us - (uint32_t)hal_time_us());
    if (!host.real_time && left > 0)
        host.time_us += (uint32_t)left;
    while (host.real_time && (int32_t)(time_us - (uint32_t)hal_time_us()) > 0)
        ;
}

int hal_read(void)
{
    return host.input_read < host.input_length ? host.input[host.input_read++] : -1;
}

void hal_write(const uint8_t *data, uint8_t length)
{
    if (host.output_length + length > HOST_BUFFER)
        return;
    memcpy(host.output + host.output_length, data, length);
    host.output_length += length;
}

void hal_motor_step(int16_t counts)
{
    int32_t before = host.position;
    if (host.stalled)
        return;
    host.position += counts;
    if (host.position < HARD_LOW)
        host.position = HARD_LOW;
    if (host.position > HARD_HIGH)
        host.position = HARD_HIGH;
    encoder += host.position - before;
}

int32_t hal_motor_counts(void)
{
    return encoder;
}

uint8_t hal_switches(void)
{
    uint8_t closed = 0;
    if (host.position <= MOTOR_HOME_SWITCH)
        closed |= HAL_HOME_CLOSED;
    if (host.position <= HARD_LOW || host.position >= HARD_HIGH)
        closed |= HAL_LIMIT_CLOSED;
    return closed;
}

void hal_panels(const uint16_t levels[PS_PANELS])
{
    uint8_t before = host.lit;
    host.lit = 0;
    for (uint8_t i = 0; i < PS_PANELS; i++)
        host.lit |= (uint8_t)((levels[i] != 0) << i);
    if (before && !host.lit)
        host.dark_since_us = hal_time_us();
}

uint8_t hal_panel_currents(void)
{
    return host.lit & (uint8_t)~host.open_panels;
}

void hal_trigger(void)
{
    host.triggers++;
}

uint16_t hal_temperature(uint8_t panel)
{
    return (uint16_t)(29600 + (panel == 5 ? host.heat : 0));
}

void hal_servo(uint16_t tilt)
{
    (void)tilt;
}
