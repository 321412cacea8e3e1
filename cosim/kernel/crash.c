/* What a crash of native code leads to: somebody is told, and has time to say so before the process ends (sigaction(2)).
 * So it is when native code ends the process by itself (exit(3)).
 *
 * A handler may do next to nothing. This one writes the number of the signal to a pipe and holds the thread that has
 * crashed, while another one (cosim/running/watching.py) says what happened and ends the process.
 */
#if !defined(_WIN32)
#define _XOPEN_SOURCE 700
#endif
#include <stddef.h>
#include <stdint.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

EXPORT void cosim_watch_crashes(int32_t told, int32_t patience_ms, int32_t screen);
EXPORT void cosim_ignore_crashes(void);

#if defined(_WIN32)

void cosim_watch_crashes(int32_t told, int32_t patience_ms, int32_t screen) { (void)told, (void)patience_ms, (void)screen; }
void cosim_ignore_crashes(void) {}

#else

#include <poll.h>
#include <signal.h>
#include <stdbool.h>
#include <stdlib.h>
#include <unistd.h>

#define N_NUMBERS 5
#define STACK_BYTES 65536 /* the thread's own may be what has overflowed */
#define PAUSE_MS 20
#define EXITED 255 /* no signal has this number */
#define FAILED 3

static const int NUMBERS[N_NUMBERS] = {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT};
static bool watched[N_NUMBERS];
static char stack[STACK_BYTES];
static stack_t previous_stack;
static int32_t told_fd, screen_fd, patience;
static volatile pid_t watcher; /* the process that is watched, 0 for none; not one that it has forked */

static void unwatch(void) {
    for (int i = 0; i < N_NUMBERS; i++)
        if (watched[i]) signal(NUMBERS[i], SIG_DFL);
}

/* Whoever is told ends the process, unless nobody is left to do so. */
static void tell(unsigned char what) {
    if (write(told_fd, &what, 1) == 1)
        for (int32_t waited = 0; waited < patience; waited += PAUSE_MS) poll(NULL, 0, PAUSE_MS);
    static const char text[] = "\nerror: native code crashed or ended the process, and nobody is left to say where\n";
    ssize_t written = write(screen_fd, text, sizeof text - 1);
    (void)written;
}

static void on_crash(int number) {
    unwatch(); /* a second crash, also of who is told, ends the process */
    if (getpid() == watcher) tell((unsigned char)number);
    raise(number); /* it takes effect when this function returns */
}

static void on_exit_of_process(void) {
    if (getpid() != watcher) return;
    watcher = 0;
    tell(EXITED);
    _exit(FAILED);
}

/* From now on a crash is told. Signals that somebody handles already stay theirs: virtual machines use some. */
void cosim_watch_crashes(int32_t told, int32_t patience_ms, int32_t screen) {
    static bool registered;
    told_fd = told, screen_fd = screen, patience = patience_ms, watcher = getpid();
    if (!registered) registered = atexit(on_exit_of_process) == 0;
    stack_t own = {.ss_sp = stack, .ss_size = sizeof stack};
    sigaltstack(&own, &previous_stack);
    for (int i = 0; i < N_NUMBERS; i++) {
        struct sigaction action = {.sa_handler = on_crash, .sa_flags = SA_ONSTACK}, present;
        watched[i] = sigaction(NUMBERS[i], NULL, &present) == 0 && !(present.sa_flags & SA_SIGINFO) &&
                     present.sa_handler == SIG_DFL && sigaction(NUMBERS[i], &action, NULL) == 0;
    }
}

/* As before; what others have put in its place since then stays. */
void cosim_ignore_crashes(void) {
    watcher = 0;
    for (int i = 0; i < N_NUMBERS; i++) {
        struct sigaction present;
        if (watched[i] && sigaction(NUMBERS[i], NULL, &present) == 0 && present.sa_handler == on_crash)
            signal(NUMBERS[i], SIG_DFL);
        watched[i] = false;
    }
    sigaltstack(&previous_stack, NULL);
}

#endif
