/* The head: commands, sessions, watchdog and faults. */
#ifndef PS_HEAD_H
#define PS_HEAD_H

void head_init(void); /* after power-up: everything off */
void head_poll(void); /* call it as often as possible */

#endif
