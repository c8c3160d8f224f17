/* Preloaded into a process: system calls fail as a broken disk's do, and the clock jumps.

FAIL_CALL: fsync, rename or write; FAIL_NAME: what the file's path must hold. JUMP: seconds by which each reading of the clock
goes on or back. Both are looked up at each call, so that a process can change them. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

static int fails(const char *call, const char *path) {
    const char *which = getenv("FAIL_CALL"), *name = getenv("FAIL_NAME");
    return which && name && *name && !strcmp(which, call) && path && strstr(path, name);
}

static int fails_at(const char *call, int descriptor) {
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", descriptor);
    ssize_t n = readlink(link, path, sizeof path - 1);
    if (n < 0) return 0;
    path[n] = 0;
    return fails(call, path);
}

int fsync(int descriptor) {
    if (fails_at("fsync", descriptor)) { errno = EIO; return -1; }
    return ((int (*)(int))dlsym(RTLD_NEXT, "fsync"))(descriptor);
}

int rename(const char *from, const char *to) {
    if (fails("rename", to)) { errno = EIO; return -1; }
    return ((int (*)(const char *, const char *))dlsym(RTLD_NEXT, "rename"))(from, to);
}

ssize_t write(int descriptor, const void *data, size_t n) {
    if (fails_at("write", descriptor)) { errno = ENOSPC; return -1; }
    return ((ssize_t (*)(int, const void *, size_t))dlsym(RTLD_NEXT, "write"))(descriptor, data, n);
}

int clock_gettime(clockid_t clock, struct timespec *time) {
    static long calls = 0;
    int result = ((int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime"))(clock, time);
    const char *jump = getenv("JUMP");
    if (jump && clock == CLOCK_REALTIME) time->tv_sec += atol(jump) * (calls++ % 2 ? 1 : -1);
    return result;
}
