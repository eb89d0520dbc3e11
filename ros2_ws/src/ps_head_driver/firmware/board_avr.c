/* Arduino Mega 2560, 16 MHz.
 *
 *   USART0          host, 115200 8N1
 *   PE4, PE5        encoder A, B (with MOTOR_ENCODER 0: counts are the steps that were sent)
 *   PG0, PG1        step, direction of the motor's driver
 *   PL0, PL1        home switch, limit switches; closed to ground
 *   PA0 to PA7      gates of the panels, high is on
 *   PC0 to PC7      panel draws current; open collector, low is yes
 *   PB0 PB1 PB2     DAC7568A (eight current set values, its reference outside): sync, clock, data
 *   PH3             camera trigger, 100 us
 *   PH4 (OC4B)      dark-field servo, 1 to 2 ms for 0 to pi
 *   PF0 to PF7      panel temperatures, 10 mV/K, 0.5 V at 273.15 K
 *
 * Timer 1 counts 0.5 us and makes the time, timer 3 the steps, timer 4 the servo pulse. The panels
 * are dimmed by their current, not by PWM, which would beat with short exposures.
 */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>
#include <util/delay.h>

#include "hal.h"
#include "head.h"

#ifndef MOTOR_ENCODER
#define MOTOR_ENCODER 1
#endif
#define RING 128 /* bytes, a power of two */
#define STEP_SLOTS 40 /* per millisecond; twice MOTOR_MAX_SPEED */

struct ring {
    volatile uint8_t head, tail;
    uint8_t data[RING];
};

static struct ring received, sending;
static volatile uint32_t overflows; /* of timer 1 */
static volatile int32_t position;
static volatile int16_t pending; /* steps */
static volatile uint8_t step_rate, step_sum;
static volatile uint16_t adc[PS_PANELS];

/* ------------------------------------------------------------------ line */

ISR(USART0_RX_vect)
{
    uint8_t byte = UDR0, next = (received.head + 1) % RING;
    if (next != received.tail) { /* a lost byte is found by the CRC */
        received.data[received.head] = byte;
        received.head = next;
    }
}

ISR(USART0_UDRE_vect)
{
    if (sending.head == sending.tail) {
        UCSR0B &= (uint8_t)~_BV(UDRIE0);
        return;
    }
    UDR0 = sending.data[sending.tail];
    sending.tail = (sending.tail + 1) % RING;
}

int hal_read(void)
{
    if (received.head == received.tail)
        return -1;
    uint8_t byte = received.data[received.tail];
    received.tail = (received.tail + 1) % RING;
    return byte;
}

void hal_write(const uint8_t *data, uint8_t length)
{
    uint8_t space = (uint8_t)(sending.tail - sending.head - 1) % RING;
    if (length > space) /* the host asks again */
        return;
    while (length--) {
        sending.data[sending.head] = *data++;
        sending.head = (sending.head + 1) % RING;
    }
    UCSR0B |= _BV(UDRIE0);
}

/* ------------------------------------------------------------------ time */

ISR(TIMER1_OVF_vect)
{
    overflows++;
}

uint64_t hal_time_us(void)
{
    uint32_t high;
    uint16_t low;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        low = TCNT1;
        high = overflows;
        if ((TIFR1 & _BV(TOV1)) && low < 0x8000) /* overflowed just now */
            high++;
    }
    return ((uint64_t)high << 15) + (low >> 1);
}

void hal_wait_until(uint32_t time_us)
{
    while ((int32_t)(time_us - (uint32_t)hal_time_us()) > 0)
        ;
}

/* ------------------------------------------------------------------ motor */

ISR(TIMER3_COMPA_vect) /* every 25 us: spreads the steps of a millisecond evenly */
{
    PORTG &= (uint8_t)~_BV(PG0);
    if (!pending)
        return;
    step_sum += step_rate;
    if (step_sum < STEP_SLOTS)
        return;
    step_sum -= STEP_SLOTS;
    PORTG |= _BV(PG0);
    int8_t direction = pending < 0 ? -1 : 1;
    pending -= direction;
#if !MOTOR_ENCODER
    position += direction;
#endif
}

#if MOTOR_ENCODER
static void encoder_edge(uint8_t same_is_up)
{
    uint8_t a = PINE >> PE4 & 1, b = PINE >> PE5 & 1;
    position += (a == b) == same_is_up ? 1 : -1;
}

ISR(INT4_vect)
{
    encoder_edge(0);
}

ISR(INT5_vect)
{
    encoder_edge(1);
}
#endif

void hal_motor_step(int16_t counts)
{
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        pending += counts; /* with what did not fit into the last millisecond */
        uint16_t rate = (uint16_t)(pending < 0 ? -pending : pending);
        step_rate = rate < STEP_SLOTS / 2 ? (uint8_t)rate : STEP_SLOTS / 2;
        if (pending < 0)
            PORTG |= _BV(PG1);
        else
            PORTG &= (uint8_t)~_BV(PG1);
    }
}

int32_t hal_motor_counts(void)
{
    int32_t now;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        now = position;
    }
    return now;
}

uint8_t hal_switches(void)
{
    uint8_t closed = (uint8_t)~PINL;
    return (closed & _BV(PL0) ? HAL_HOME_CLOSED : 0) | (closed & _BV(PL1) ? HAL_LIMIT_CLOSED : 0);
}

/* ------------------------------------------------------------------ light */

static void dac_send(uint32_t word)
{
    PORTB &= (uint8_t)~_BV(PB0);
    for (int8_t shift = 24; shift >= 0; shift -= 8) {
        SPDR = (uint8_t)(word >> shift);
        while (!(SPSR & _BV(SPIF)))
            ;
    }
    PORTB |= _BV(PB0);
}

void hal_panels(const uint16_t levels[PS_PANELS])
{
    static uint16_t set[PS_PANELS];
    uint8_t gates = 0;
    for (uint8_t i = 0; i < PS_PANELS; i++)
        gates |= (uint8_t)((levels[i] != 0) << i);
    PORTA &= gates; /* off at once, on with the right current only */
    for (uint8_t i = 0; i < PS_PANELS; i++) {
        if (levels[i] == set[i])
            continue;
        set[i] = levels[i];
        dac_send(0x03UL << 24 | (uint32_t)i << 20 | (uint32_t)(levels[i] >> 4) << 8);
    }
    PORTA = gates;
}

uint8_t hal_panel_currents(void)
{
    return (uint8_t)~PINC;
}

void hal_trigger(void)
{
    PORTH |= _BV(PH3);
    _delay_us(100);
    PORTH &= (uint8_t)~_BV(PH3);
}

void hal_servo(uint16_t tilt)
{
    OCR4B = (uint16_t)(2000 + (uint32_t)tilt * 2000 / 31416); /* 0.5 us */
}

ISR(ADC_vect) /* one panel after the other, all the time */
{
    uint8_t panel = ADMUX & 7;
    adc[panel] = ADC;
    ADMUX = _BV(REFS0) | ((panel + 1) & 7);
    ADCSRA |= _BV(ADSC);
}

uint16_t hal_temperature(uint8_t panel)
{
    uint16_t level;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        level = adc[panel];
    }
    return (uint16_t)(22315 + (uint32_t)level * 50000 / 1024); /* 10 mV/K, 5 V full scale */
}

/* ------------------------------------------------------------------ board */

uint8_t hal_capabilities(void)
{
    return PS_MOTOR | PS_LIGHTS;
}

const char *hal_serial(void)
{
    return "PSH-MEGA2560";
}

int main(void)
{
    DDRA = 0xFF;
    DDRB = _BV(PB0) | _BV(PB1) | _BV(PB2);
    DDRG = _BV(PG0) | _BV(PG1);
    DDRH = _BV(PH3) | _BV(PH4);
    PORTB = _BV(PB0);
    PORTL = _BV(PL0) | _BV(PL1);
    PORTE = _BV(PE4) | _BV(PE5);

    UCSR0A = _BV(U2X0);
    UBRR0 = F_CPU / 8 / 115200 - 1;
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);

    TCCR1B = _BV(CS11); /* 2 MHz */
    TIMSK1 = _BV(TOIE1);
    OCR3A = F_CPU / 40000 - 1;
    TCCR3B = _BV(WGM32) | _BV(CS30);
    TIMSK3 = _BV(OCIE3A);
    ICR4 = 39999; /* 20 ms at 2 MHz */
    TCCR4A = _BV(COM4B1) | _BV(WGM41);
    TCCR4B = _BV(WGM43) | _BV(WGM42) | _BV(CS41);

#if MOTOR_ENCODER
    EICRB = _BV(ISC40) | _BV(ISC50); /* both edges */
    EIMSK = _BV(INT4) | _BV(INT5);
#endif
    SPCR = _BV(SPE) | _BV(MSTR) | _BV(CPHA);
    ADMUX = _BV(REFS0);
    ADCSRA = _BV(ADEN) | _BV(ADIE) | _BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0) | _BV(ADSC);
    sei();

    head_init();
    for (;;)
        head_poll();
}
