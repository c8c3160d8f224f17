/* Preloaded into a process: system calls fail as a broken disk's do, and the clock jumps.

FAIL_CALL: fsync, rename, write or, as of a disk that was mounted anew to be read only, change: opening for writing, rename and
unlink. FAIL_NAME: what the file's path must hold, or several texts with | between them, one of which it must hold. JUMP: seconds
by which each reading of the clock goes on or back. Both are looked up at each call, so that a process can change them. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

static int fails(const char *call, const char *path) {
    const char *which = getenv("FAIL_CALL"), *name = getenv("FAIL_NAME");
    if (!which || !name || strcmp(which, call) || !path) return 0;
    char names[4096], *rest = names;
    snprintf(names, sizeof names, "%s", name);
    for (char *one; (one = strsep(&rest, "|"));)
        if (*one && strstr(path, one)) return 1;
    return 0;
}

static int is_read_only(const char *path) {
    if (!fails("change", path)) return 0;
    errno = EROFS;
    return 1;
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

#define NEXT(name, type) ((type)dlsym(RTLD_NEXT, name))

/* Each has a second name, for files beyond 2 GB. */
#define OPENS(name)                                                                     \
    int name(const char *path, int flags, ...) {                                        \
        va_list rest;                                                                   \
        va_start(rest, flags);                                                          \
        mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(rest, mode_t) : 0;         \
        va_end(rest);                                                                   \
        if ((flags & O_ACCMODE) != O_RDONLY && is_read_only(path)) return -1;           \
        return NEXT(#name, int (*)(const char *, int, ...))(path, flags, mode);         \
    }
#define FOPENS(name)                                                                    \
    FILE *name(const char *path, const char *mode) {                                    \
        if (strpbrk(mode, "wa+") && is_read_only(path)) return NULL;                    \
        return NEXT(#name, FILE *(*)(const char *, const char *))(path, mode);          \
    }
#define MKSTEMPS(name)                                                                  \
    int name(char *path) { return is_read_only(path) ? -1 : NEXT(#name, int (*)(char *))(path); }
OPENS(open)
OPENS(open64)
FOPENS(fopen)
FOPENS(fopen64)
MKSTEMPS(mkstemp)
MKSTEMPS(mkstemp64)

int unlink(const char *path) {
    if (is_read_only(path)) return -1;
    return ((int (*)(const char *))dlsym(RTLD_NEXT, "unlink"))(path);
}

int rename(const char *from, const char *to) {
    if (is_read_only(to)) return -1;
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
