/* The firmware as a process on the real clock: the line is its standard input and output. */
#include <poll.h>
#include <unistd.h>

#include "board_host.h"
#include "head.h"

int main(void)
{
    host.real_time = true;
    host_power_up(3, 9000);
    for (;;) {
        struct pollfd line = {.fd = STDIN_FILENO, .events = POLLIN};
        poll(&line, 1, 1);
        if (host.input_read == host.input_length && line.revents) {
            ssize_t length = read(STDIN_FILENO, host.input, sizeof host.input);
            if (length <= 0)
                return 0;
            host.input_length = (uint32_t)length;
            host.input_read = 0;
        }
        head_poll();
        uint32_t sent = 0;
        while (sent < host.output_length) {
            ssize_t some = write(STDOUT_FILENO, host.output + sent, host.output_length - sent);
            if (some <= 0)
                return 1;
            sent += (uint32_t)some;
        }
        host.output_length = 0;
    }
}
