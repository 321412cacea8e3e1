/* The yardstick of benchmarks/instances.py: instances of one FMU, opened and initialised by hand. */
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>

#include "fmi2FunctionTypes.h"
#include "fmi3FunctionTypes.h"

static void ignore2(fmi2ComponentEnvironment e, fmi2String n, fmi2Status s, fmi2String c, fmi2String m, ...) {
    (void)e, (void)n, (void)s, (void)c, (void)m;
}
static void ignore3(fmi3InstanceEnvironment e, fmi3Status s, fmi3String c, fmi3String m) {
    (void)e, (void)s, (void)c, (void)m;
}
static const fmi2CallbackFunctions callbacks = {ignore2, calloc, free, NULL, NULL};

/* Memory of the process in bytes. */
static long resident(void) {
    long total = 0, pages = 0;
    FILE *file = fopen("/proc/self/statm", "r");
    if (file == NULL) return 0;
    if (fscanf(file, "%ld %ld", &total, &pages) != 2) pages = 0;
    fclose(file);
    return pages * sysconf(_SC_PAGESIZE);
}

static void *open2(void *library, const char *token, int exchange) {
    fmi2InstantiateTYPE *instantiate = (fmi2InstantiateTYPE *)dlsym(library, "fmi2Instantiate");
    fmi2SetupExperimentTYPE *set_up = (fmi2SetupExperimentTYPE *)dlsym(library, "fmi2SetupExperiment");
    fmi2EnterInitializationModeTYPE *enter =
        (fmi2EnterInitializationModeTYPE *)dlsym(library, "fmi2EnterInitializationMode");
    fmi2ExitInitializationModeTYPE *leave =
        (fmi2ExitInitializationModeTYPE *)dlsym(library, "fmi2ExitInitializationMode");
    fmi2Type type = exchange ? fmi2ModelExchange : fmi2CoSimulation;
    void *instance = instantiate("instance", type, token, "file:///tmp/", &callbacks, fmi2False, fmi2False);
    if (!instance || set_up(instance, fmi2False, 0.0, 0.0, fmi2True, 1.0) > fmi2Warning) return NULL;
    return enter(instance) > fmi2Warning || leave(instance) > fmi2Warning ? NULL : instance;
}

static void *open3(void *library, const char *token, int exchange) {
    fmi3InstantiateModelExchangeTYPE *to_exchange =
        (fmi3InstantiateModelExchangeTYPE *)dlsym(library, "fmi3InstantiateModelExchange");
    fmi3InstantiateCoSimulationTYPE *to_step =
        (fmi3InstantiateCoSimulationTYPE *)dlsym(library, "fmi3InstantiateCoSimulation");
    fmi3EnterInitializationModeTYPE *enter =
        (fmi3EnterInitializationModeTYPE *)dlsym(library, "fmi3EnterInitializationMode");
    fmi3ExitInitializationModeTYPE *leave =
        (fmi3ExitInitializationModeTYPE *)dlsym(library, "fmi3ExitInitializationMode");
    void *instance = exchange ? to_exchange("instance", token, "/tmp/", false, false, NULL, ignore3)
                              : to_step("instance", token, "/tmp/", false, false, false, false, NULL, 0, NULL,
                                        ignore3, NULL);
    if (!instance || enter(instance, false, 0.0, 0.0, true, 1.0) > fmi3Warning) return NULL;
    return leave(instance) > fmi3Warning ? NULL : instance;
}

/* Bytes that the process grows by with `n` instances, or -1. */
__attribute__((visibility("default"))) long bare_instances(const char *path, const char *token, int fmi, int exchange,
                                                           int n) {
    void *library = dlopen(path, RTLD_NOW | RTLD_LOCAL);
    if (library == NULL) return -1;
    void *(*open)(void *, const char *, int) = fmi == 2 ? open2 : open3;
    if (open(library, token, exchange) == NULL) return -1; /* what the first one costs is not an instance's */
    long before = resident();
    for (int i = 0; i < n; i++)
        if (open(library, token, exchange) == NULL) return -1;
    return resident() - before;
}
