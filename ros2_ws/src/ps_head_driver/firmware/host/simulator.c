/* The real firmware in simavr; the line is standard input and output: simulator head.elf. */
#include <fcntl.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_time.h>
#include <stdio.h>
#include <time.h>
#include <unistd.h>

static void from_board(struct avr_irq_t *irq, uint32_t value, void *parameter)
{
    (void)irq;
    (void)parameter;
    uint8_t byte = (uint8_t)value;
    if (write(STDOUT_FILENO, &byte, 1) != 1)
        _exit(1);
}

static uint64_t real_us(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000u + (uint64_t)now.tv_nsec / 1000u;
}

int main(int count, char **arguments)
{
    elf_firmware_t firmware = {0};
    if (count != 2 || elf_read_firmware(arguments[1], &firmware))
        return 2;
    avr_t *avr = avr_make_mcu_by_name("atmega2560");
    avr_init(avr);
    firmware.frequency = 16000000;
    avr_load_firmware(avr, &firmware);
    uint32_t flags = 0; /* no echo, and no sleep while the line is polled */
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT),
                            from_board, NULL);
    avr_irq_t *to_board = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    fcntl(STDIN_FILENO, F_SETFL, fcntl(STDIN_FILENO, F_GETFL) | O_NONBLOCK);

    uint64_t start = real_us(), next_byte_us = 0;
    for (;;) {
        int state = avr_run(avr);
        if (state == cpu_Done || state == cpu_Crashed)
            return 1;
        uint64_t now_us = avr->cycle / 16;
        if (now_us < next_byte_us)
            continue;
        next_byte_us = now_us + 100; /* a byte at 115200 bit/s takes 87 */
        uint8_t byte;
        ssize_t length = read(STDIN_FILENO, &byte, 1);
        if (length == 0)
            return 0;
        if (length == 1)
            avr_raise_irq(to_board, byte);
        if (real_us() - start < now_us) /* not faster than the real board */
            usleep(100);
    }
}
