/* The native micro-step loop of agents whose components are all FMUs.
 *
 * It carries out the floating-point operations of cosim/agents/coupling.py in the same order and so gives the same bits; that
 * file is the reference and says what the methods are. All memory belongs to the caller: nothing is allocated here, and
 * there is no state outside `Agent` and `Member`. Every function that can fail returns false after noting why in `agent->failure`.
 *
 * The structs are mirrored in cosim/kernel/layout.py, which compares their sizes when it loads the library.
 */
#ifndef NETCOSIM_KERNEL_H
#define NETCOSIM_KERNEL_H

#include <stdbool.h>
#include <stdint.h>

#define NANOSECONDS_PER_SECOND 1e9
#define EVENT_ITERATIONS 100          /* as in cosim/agents/coupling.py */
#define SETTLED 1e-9                  /* as in cosim/agents/algebraic.py */
#define DISCRETE_STATE_ITERATIONS 100 /* as in cosim/components/fmu/component.py */
#define EVENTS_PER_STEP 100           /* as in cosim/components/fmu/component.py */
#define SHORTEST 1e-9                 /* likewise */
#define STATE_EVENTS_PER_STEP 100     /* as in cosim/agents/crossings.py */
#define FIRST_PART 4096               /* likewise */
#define GROWTH 4                      /* likewise */
#define LONGER 2.0                    /* as in cosim/agents/extrapolation.py */
#define STAGES 7                      /* of the Dormand-Prince pair; Runge-Kutta 4 needs four */

typedef enum { RK4, DORMAND_PRINCE, EULER } Integrator;
typedef enum { JOINT, MIDPOINT, GAUSS_SEIDEL, JACOBI } Method;

/* How the values of a variable lie in memory. FMI 2.0 has FLOAT64, INT32 and its own Boolean, an int. */
typedef enum {
    FLOAT64,
    FLOAT32,
    INT8,
    UINT8,
    INT16,
    UINT16,
    INT32,
    UINT32,
    INT64,
    UINT64,
    BOOLEAN,
    FMI2_BOOLEAN,
    N_TYPES
} Type;

/* The FMI functions that the loop calls; getters and setters follow, one per type. */
typedef enum {
    SET_TIME,
    SET_STATES,
    GET_STATES,
    GET_DERIVATIVES,
    GET_INDICATORS,
    COMPLETED_STEP,
    ENTER_EVENT_MODE,
    UPDATE_DISCRETE_STATES,
    ENTER_CONTINUOUS_TIME_MODE,
    ENTER_STEP_MODE,
    DO_STEP,
    GET_VALUES,
    SET_VALUES = GET_VALUES + N_TYPES,
    N_CALLS = SET_VALUES + N_TYPES
} Call;

typedef void (*Function)(void);

typedef struct {
    int32_t fmi; /* 2 or 3 */
    int32_t n_states;
    int32_t first_state; /* where its states lie among those of the agent */
    int32_t reads_earlier; /* an input is connected to a component earlier in the file's order */
    int32_t n_indicators;
    int32_t first_indicator; /* where its event indicators lie among those of the agent */
    int32_t uses_events;     /* Co-Simulation with an Event Mode */
    int32_t discrete;        /* it takes its connected inputs there only */
    int32_t parts[2];        /* steps of its own that it makes in a micro step, and in half of one */
    void *instance;
    const Function *functions; /* N_CALLS */
} Component;

/* Values of one type that move between a component and the signals. */
typedef struct {
    int32_t component;
    int32_t to_component; /* else from it */
    int32_t type;
    int32_t n_references;
    int32_t n_values;
    int32_t begin; /* the first position, if the others follow it one by one and no value is scaled; else -1 */
    const uint32_t *references; /* n_references */
    const int32_t *positions;   /* n_values, indices into the signals */
    void *buffer;               /* n_values of the type */
    const double *gains;        /* n_values: the values are scaled on their way; NULL where none is */
    const double *offsets;      /* n_values, with `gains` */
} Transfer;

/* Transfers from `first` up to, but not including, `last`. */
typedef struct {
    int32_t first;
    int32_t last;
} Transfers;

typedef enum {
    NOTHING,
    CALL_FAILED,
    STOP_REQUESTED,
    EARLY_RETURN,
    OUTPUT_NOT_FINITE,
    STATE_NOT_FINITE,
    EVENTS_UNSETTLED,
    DISCRETE_STATES_UNSETTLED,
    STEP_TOO_SMALL,
    INDICATOR_NAN,
    CHATTERING,
    TOO_MANY_EVENTS
} Reason;

typedef struct {
    int32_t reason;
    int32_t component;
    int32_t call;
    int32_t status;   /* what the FMI call returned */
    int32_t transfer; /* OUTPUT_NOT_FINITE */
    int32_t index;    /* of the value in the transfer, or of the component's state or event indicator */
    double value;     /* time reached, or step size */
} Failure;

/* What reaches several agents during ticks that follow each other, tick by tick and agent by agent, in the order of
 * arrival (network/messages.py). */
typedef struct {
    const int64_t *ends; /* where the deliveries of each agent begin, tick by tick, and the end */
    const int64_t *arrival_ns;
    const int64_t *slot;
    const int64_t *stamp;
    const double *values; /* rows of the message's width */
} Mail;

/* The agent at hand. All but what it remembers is shared by agents that are wired alike. */
typedef struct {
    /* What the agent consists of. */
    int32_t n_components;
    int32_t n_states;
    int32_t n_signals;
    int32_t n_indicators;
    int32_t width; /* numbers in a message */
    int32_t grid;  /* every micro step has the same length, and arrivals wait for its end */
    const Component *components;
    const Transfer *transfers;
    const Transfers *outputs; /* n_components */
    const Transfers *inputs;  /* n_components */
    Transfers propagate; /* at events */
    Transfers follow;    /* between events: continuous inputs only */
    Transfers listen;
    Transfers sample;
    const int32_t *owner; /* n_signals: the component whose output it is, -1 for the mailbox */
    const bool *continuous; /* n_signals: it is an output that changes continuously */
    const int32_t *mailbox_values; /* one row of `width` positions per in-neighbour */
    const int32_t *mailbox_stamp;
    const int32_t *mailbox_time;

    /* How it is coupled. */
    int32_t method;
    int32_t integrator;
    int64_t step_ns;
    int64_t refinement; /* micro steps made in the place of each */
    double relative_tolerance;
    double absolute_tolerance;

    /* What the loop remembers (cosim.agents.coupling.LoopState). */
    double *signals;
    double *previous;
    double *steps;
    double *next_event;
    double *time;

    /* Scratch. */
    double *before;     /* n_signals */
    double *middle;     /* n_signals */
    double *source;     /* n_signals */
    double *states;     /* n_states */
    double *new_states; /* n_states */
    double *stages;     /* STAGES rows of n_states */
    double *indicators; /* four rows of n_indicators: before a step, after it, and two in between */

    volatile int64_t *called; /* the component that is being called: others look at it */

    Failure failure;
} Agent;

/* One agent of a block: what it does not share. */
typedef struct {
    Agent *agent; /* of its kind; the pointers below are put into it while this one advances */
    const Component *components;
    double *signals;
    double *previous;
    double *steps;
    double *next_event;
    double *time;
    int64_t place; /* among the receivers of the mail */
} Member;

/* Some of the signals of a process, in the order in which they are wanted. */
typedef struct {
    int64_t n;
    const int64_t *places;
} Selection;

/* Agents that are advanced by one call. */
typedef struct {
    int64_t n_members;
    int64_t n_receivers; /* of the mail of a tick */
    int64_t period_ns;
    const Member *members;
    volatile int64_t *attended; /* the tick from which members are being advanced, the place of the one that is, and its
                                   component that is being called: others look at it */
    const double *signals; /* of all receivers of the mail */
    Selection samples; /* what they publish */
    Selection row;     /* what is recorded of them */
    int64_t failed;    /* which member has */
} Block;

static inline double to_seconds(int64_t nanoseconds) { return (double)nanoseconds / NANOSECONDS_PER_SECOND; }

/* How many equal micro steps, none longer than the coupling's, from one time to another; their length in seconds. */
int64_t micro_steps(const Agent *agent, int64_t start_ns, int64_t end_ns, double *length);

bool fail(Agent *agent, Failure failure);

/* values.c: `source` is what goes to the components, usually the signals. */
bool carry_out(Agent *agent, Transfers transfers, const double *source);

/* events.c */
bool handle_event(Agent *agent, int64_t time_ns, bool listen);
bool enter_event_mode(Agent *agent);
bool iterate_events(Agent *agent);
bool leave_events(Agent *agent, int component); /* Co-Simulation: from Event Mode to Step Mode */

/* The first time event of a component after a time in seconds, when it is due, or the end. */
int64_t next_stop(const Agent *agent, double start, int64_t end_ns);

/* joint.c: where it stopped, which is earlier than `end_ns` if there is a state event, or a time event that a step event on
 * the way has scheduled. */
typedef struct {
    int64_t time_ns;
    int32_t component; /* that has a state event, or -1 */
    bool scheduled;
} Stop;
bool integrate_states(Agent *agent, int64_t start_ns, int64_t end_ns, Stop *stop);

/* crossings.c: state events, as in cosim/agents/crossings.py */
typedef struct {
    int64_t low;
    int64_t high;
} Bracket;
typedef bool (*Evaluate)(Agent *agent, const void *step, int64_t time_ns, double *indicators);

/* After a state event: how long the next step is, and the one after that where nothing crosses (0: as usual). */
int64_t cautious_step(int64_t step_ns);
int64_t less_cautious(int64_t cautious_ns, int64_t step_ns);
bool has_crossed(double before, double after);
bool any_crossed(const Agent *agent, const double *before, const double *after);
Bracket bracket(double start, double reached, int64_t start_ns, int64_t end_ns, bool final);
bool first_crossing(Agent *agent, Bracket ends, Evaluate evaluate, const void *step, int64_t *found);

/* steps.c */
bool step_components(Agent *agent, int64_t start_ns, int64_t end_ns);

#endif
