/* A library for LD_PRELOAD that logs what a program changes below a folder, with all data.
 *
 * DISK_LOG_FOLDER: the folder, an absolute path without links
 * DISK_LOG_FILE:   the log, to which records are appended
 * DISK_LOG_BOOT:   a file that is read in place of the boot ID of the kernel
 *
 * Without the first two, only the boot ID is replaced. A record is a struct head, then the path,
 * the second path and the data. tests/support/disk_log.rs reads it. A lock orders the records in the
 * way in which the changes happened. A sync has two records, because changes during a sync may or may
 * not be part of it.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

enum kind { CREATE = 1, FOLDER, WRITE, LENGTH, RENAME, REMOVE, SYNC, SYNCED, UNKNOWN };

struct head {
    uint64_t kind, time_ns, inode, offset, path, to, data;
};

#define NEXT(name, type, ...)                                   \
    static type (*next)(__VA_ARGS__);                           \
    if (!next) next = (type(*)(__VA_ARGS__))dlsym(RTLD_NEXT, #name)

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static const char *folder, *boot;
static size_t folder_bytes;
static int log_fd = -1;
static uint64_t syncs;

static int plain_open(const char *path, int flags, mode_t mode)
{
    NEXT(open64, int, const char *, int, ...);
    return next(path, flags, mode);
}

__attribute__((constructor)) static void begin(void)
{
    const char *file = getenv("DISK_LOG_FILE");
    boot = getenv("DISK_LOG_BOOT");
    if (!file || !getenv("DISK_LOG_FOLDER")) return;
    log_fd = plain_open(file, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
    folder = getenv("DISK_LOG_FOLDER");
    folder_bytes = strlen(folder);
}

static void record(enum kind kind, uint64_t inode, uint64_t offset, const char *path, const char *to,
                   const struct iovec *data, int count, size_t bytes)
{
    NEXT(writev, ssize_t, int, const struct iovec *, int);
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    struct head head = {kind, (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec, inode, offset,
                        path ? strlen(path) : 0, to ? strlen(to) : 0, bytes};
    struct iovec parts[IOV_MAX];
    int used = 0;
    parts[used++] = (struct iovec){&head, sizeof head};
    if (path) parts[used++] = (struct iovec){(void *)path, head.path};
    if (to) parts[used++] = (struct iovec){(void *)to, head.to};
    for (int i = 0; i < count && bytes; i++) { /* a write may be shorter than asked for */
        size_t part = data[i].iov_len < bytes ? data[i].iov_len : bytes;
        parts[used++] = (struct iovec){data[i].iov_base, part};
        bytes -= part;
    }
    size_t all = 0;
    for (int i = 0; i < used; i++) all += parts[i].iov_len;
    if (next(log_fd, parts, used) != (ssize_t)all) abort(); /* a log with a hole proves nothing */
}

/* Stores the absolute path in `found`, and returns 1 if it is below the folder. */
static int is_below(int at, const char *path, char *found)
{
    if (log_fd < 0 || !path) return 0;
    if (path[0] == '/') {
        snprintf(found, PATH_MAX, "%s", path);
    } else {
        char base[PATH_MAX], link[64];
        if (at == AT_FDCWD) {
            if (!getcwd(base, sizeof base)) return 0;
        } else {
            snprintf(link, sizeof link, "/proc/self/fd/%d", at);
            ssize_t length = readlink(link, base, sizeof base - 1);
            if (length < 0) return 0;
            base[length] = 0;
        }
        if (snprintf(found, PATH_MAX, "%s/%s", base, path) >= PATH_MAX) return 0;
    }
    return strncmp(found, folder, folder_bytes) == 0 && found[folder_bytes] == '/';
}

/* Returns 1 if an open file or folder is below the folder, with its path and its state. */
static int is_tracked(int fd, char *found, struct stat *state)
{
    if (log_fd < 0 || fd == log_fd || fstat(fd, state)) return 0;
    if (!S_ISREG(state->st_mode) && !S_ISDIR(state->st_mode)) return 0;
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, found, PATH_MAX - 1);
    if (length < 0) return 0;
    found[length] = 0;
    return strncmp(found, folder, folder_bytes) == 0 &&
           (found[folder_bytes] == '/' || !found[folder_bytes]);
}

static void unknown(int fd, const char *name)
{
    char path[PATH_MAX];
    struct stat state;
    int before = errno;
    if (is_tracked(fd, path, &state)) {
        pthread_mutex_lock(&lock);
        record(UNKNOWN, state.st_ino, 0, path, name, NULL, 0, 0);
        pthread_mutex_unlock(&lock);
    }
    errno = before;
}

static int logged_open(int at, const char *path, int flags, mode_t mode)
{
    NEXT(openat64, int, int, const char *, int, ...);
    char found[PATH_MAX];
    if (boot && path && !strcmp(path, "/proc/sys/kernel/random/boot_id")) path = boot;
    int may_change = flags & (O_CREAT | O_TRUNC);
    if (!may_change || !is_below(at, path, found)) return next(at, path, flags, mode);
    pthread_mutex_lock(&lock);
    struct stat state;
    int existed = !lstat(found, &state);
    int fd = next(at, path, flags, mode);
    int why = errno;
    if (fd >= 0) {
        if (!existed && !fstat(fd, &state))
            record(CREATE, state.st_ino, 0, found, NULL, NULL, 0, 0);
        else if (flags & O_TRUNC)
            record(LENGTH, state.st_ino, 0, NULL, NULL, NULL, 0, 0);
    }
    pthread_mutex_unlock(&lock);
    errno = why;
    return fd;
}

#define MODE(flags)                              \
    mode_t mode = 0;                             \
    if ((flags) & (O_CREAT | __O_TMPFILE)) {     \
        va_list rest;                            \
        va_start(rest, flags);                   \
        mode = va_arg(rest, mode_t);             \
        va_end(rest);                            \
    }

int open(const char *path, int flags, ...) { MODE(flags) return logged_open(AT_FDCWD, path, flags, mode); }
int open64(const char *path, int flags, ...) { MODE(flags) return logged_open(AT_FDCWD, path, flags, mode); }
int openat(int at, const char *path, int flags, ...) { MODE(flags) return logged_open(at, path, flags, mode); }
int openat64(int at, const char *path, int flags, ...) { MODE(flags) return logged_open(at, path, flags, mode); }
int creat(const char *path, mode_t mode) { return logged_open(AT_FDCWD, path, O_CREAT | O_WRONLY | O_TRUNC, mode); }
int creat64(const char *path, mode_t mode) { return logged_open(AT_FDCWD, path, O_CREAT | O_WRONLY | O_TRUNC, mode); }

/* Runs `call`, which returns the number of written bytes, and logs them at `at`, or before the
 * position of the file if `at` is negative. */
#define LOGGED_WRITE(fd, data, count, at, call)                                              \
    char path[PATH_MAX];                                                                     \
    struct stat state;                                                                       \
    if (!is_tracked(fd, path, &state)) return call;                                          \
    pthread_mutex_lock(&lock);                                                               \
    ssize_t done = call;                                                                     \
    int why = errno;                                                                         \
    if (done > 0)                                                                            \
        record(WRITE, state.st_ino, (at) < 0 ? lseek64(fd, 0, SEEK_CUR) - done : (at), NULL, \
               NULL, data, count, (size_t)done);                                             \
    pthread_mutex_unlock(&lock);                                                             \
    errno = why;                                                                             \
    return done

ssize_t write(int fd, const void *data, size_t bytes)
{
    NEXT(write, ssize_t, int, const void *, size_t);
    struct iovec all = {(void *)data, bytes};
    LOGGED_WRITE(fd, &all, 1, (off64_t)-1, next(fd, data, bytes));
}

ssize_t writev(int fd, const struct iovec *parts, int count)
{
    NEXT(writev, ssize_t, int, const struct iovec *, int);
    LOGGED_WRITE(fd, parts, count, (off64_t)-1, next(fd, parts, count));
}

ssize_t pwrite64(int fd, const void *data, size_t bytes, off64_t at)
{
    NEXT(pwrite64, ssize_t, int, const void *, size_t, off64_t);
    struct iovec all = {(void *)data, bytes};
    LOGGED_WRITE(fd, &all, 1, at, next(fd, data, bytes, at));
}

ssize_t pwrite(int fd, const void *data, size_t bytes, off_t at) { return pwrite64(fd, data, bytes, at); }

ssize_t pwritev64(int fd, const struct iovec *parts, int count, off64_t at)
{
    NEXT(pwritev64, ssize_t, int, const struct iovec *, int, off64_t);
    LOGGED_WRITE(fd, parts, count, at, next(fd, parts, count, at));
}

ssize_t pwritev(int fd, const struct iovec *parts, int count, off_t at) { return pwritev64(fd, parts, count, at); }

int ftruncate64(int fd, off64_t length)
{
    NEXT(ftruncate64, int, int, off64_t);
    char path[PATH_MAX];
    struct stat state;
    if (!is_tracked(fd, path, &state)) return next(fd, length);
    pthread_mutex_lock(&lock);
    int failed = next(fd, length), why = errno;
    if (!failed) record(LENGTH, state.st_ino, (uint64_t)length, NULL, NULL, NULL, 0, 0);
    pthread_mutex_unlock(&lock);
    errno = why;
    return failed;
}

int ftruncate(int fd, off_t length) { return ftruncate64(fd, length); }

static int logged_sync(int fd, int (*sync)(int))
{
    char path[PATH_MAX];
    struct stat state;
    if (!is_tracked(fd, path, &state)) return sync(fd);
    pthread_mutex_lock(&lock);
    uint64_t number = ++syncs;
    record(SYNC, state.st_ino, number, S_ISDIR(state.st_mode) ? path : NULL, NULL, NULL, 0, 0);
    pthread_mutex_unlock(&lock);
    int failed = sync(fd), why = errno;
    if (!failed) {
        pthread_mutex_lock(&lock);
        record(SYNCED, state.st_ino, number, NULL, NULL, NULL, 0, 0);
        pthread_mutex_unlock(&lock);
    }
    errno = why;
    return failed;
}

int fsync(int fd) { NEXT(fsync, int, int); return logged_sync(fd, next); }
int fdatasync(int fd) { NEXT(fdatasync, int, int); return logged_sync(fd, next); }

/* Runs `call`, which returns 0 on success, and logs the change of a name. */
#define LOGGED_NAME(kind, from_at, from, to_at, to, call)                                      \
    char path[PATH_MAX], second[PATH_MAX];                                                     \
    int here = is_below(from_at, from, path), there = (to) && is_below(to_at, to, second);     \
    if (!here && !there) return call;                                                          \
    pthread_mutex_lock(&lock);                                                                 \
    int failed = call, why = errno;                                                            \
    struct stat state = {0};                                                                   \
    if (!failed) {                                                                             \
        if ((kind) == FOLDER) lstat(path, &state);                                             \
        record((to) && !(here && there) ? UNKNOWN : (kind), state.st_ino, 0, here ? path : second, \
               there ? second : NULL, NULL, 0, 0);                                             \
    }                                                                                          \
    pthread_mutex_unlock(&lock);                                                               \
    errno = why;                                                                               \
    return failed

#define NONE ((const char *)NULL)

int mkdirat(int at, const char *from, mode_t mode)
{
    NEXT(mkdirat, int, int, const char *, mode_t);
    LOGGED_NAME(FOLDER, at, from, 0, NONE, next(at, from, mode));
}

int mkdir(const char *from, mode_t mode) { return mkdirat(AT_FDCWD, from, mode); }

int renameat2(int from_at, const char *from, int to_at, const char *to, unsigned flags)
{
    NEXT(renameat2, int, int, const char *, int, const char *, unsigned);
    LOGGED_NAME(flags & RENAME_EXCHANGE ? UNKNOWN : RENAME, from_at, from, to_at, to,
                next(from_at, from, to_at, to, flags));
}

int renameat(int from_at, const char *from, int to_at, const char *to) { return renameat2(from_at, from, to_at, to, 0); }
int rename(const char *from, const char *to) { return renameat2(AT_FDCWD, from, AT_FDCWD, to, 0); }

int unlinkat(int at, const char *from, int flags)
{
    NEXT(unlinkat, int, int, const char *, int);
    LOGGED_NAME(REMOVE, at, from, 0, NONE, next(at, from, flags));
}

int unlink(const char *from) { return unlinkat(AT_FDCWD, from, 0); }
int rmdir(const char *from) { return unlinkat(AT_FDCWD, from, AT_REMOVEDIR); }

int linkat(int from_at, const char *from, int to_at, const char *to, int flags)
{
    NEXT(linkat, int, int, const char *, int, const char *, int);
    LOGGED_NAME(UNKNOWN, from_at, from, to_at, to, next(from_at, from, to_at, to, flags));
}

int link(const char *from, const char *to) { return linkat(AT_FDCWD, from, AT_FDCWD, to, 0); }

/* Calls that the program does not make today. The test fails if that changes. */
int posix_fallocate64(int fd, off64_t at, off64_t bytes)
{
    NEXT(posix_fallocate64, int, int, off64_t, off64_t);
    unknown(fd, "posix_fallocate");
    return next(fd, at, bytes);
}
int posix_fallocate(int fd, off_t at, off_t bytes) { return posix_fallocate64(fd, at, bytes); }
int fallocate64(int fd, int mode, off64_t at, off64_t bytes)
{
    NEXT(fallocate64, int, int, int, off64_t, off64_t);
    unknown(fd, "fallocate");
    return next(fd, mode, at, bytes);
}
int fallocate(int fd, int mode, off_t at, off_t bytes) { return fallocate64(fd, mode, at, bytes); }
ssize_t copy_file_range(int in, off64_t *in_at, int out, off64_t *out_at, size_t bytes, unsigned flags)
{
    NEXT(copy_file_range, ssize_t, int, off64_t *, int, off64_t *, size_t, unsigned);
    unknown(out, "copy_file_range");
    return next(in, in_at, out, out_at, bytes, flags);
}
ssize_t sendfile64(int out, int in, off64_t *at, size_t bytes)
{
    NEXT(sendfile64, ssize_t, int, int, off64_t *, size_t);
    unknown(out, "sendfile");
    return next(out, in, at, bytes);
}
ssize_t sendfile(int out, int in, off_t *at, size_t bytes) { return sendfile64(out, in, at, bytes); }
