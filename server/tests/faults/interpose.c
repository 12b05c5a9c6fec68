/* Loaded before the C library: fails the n-th write, sync, read or allocation that SQLite makes, or
 * delays it.
 *
 * A file that both sides map says what is to fail; all numbers are 64-bit and little-endian:
 *   kind       which call (see `enum kind`), 0 for none
 *   countdown  the call that fails, counted from 1
 *   lasting    not 0: all later ones fail too
 *   fired      how many have failed
 *   ready      written at the start: bit 0 loaded, bit 1 SQLite's allocator found
 *   delay_ms   how long a slow sync takes
 *
 * What hangs goes on when something else is set.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <errno.h>
#include <fcntl.h>
#include <link.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/statvfs.h>
#include <unistd.h>

enum kind { NONE, WRITE_FULL, WRITE_IO, SYNC_IO, READ_IO, READ_GARBAGE, NO_MEMORY, SYNC_SLOW, HANG };

struct control {
    _Atomic uint64_t kind, countdown, lasting, fired, ready, delay_ms;
};

static struct control nothing;
static struct control *control = &nothing;
static uintptr_t allocator[2][2];

static int fires(enum kind kind) {
    if (atomic_load(&control->kind) != kind) return 0;
    uint64_t before = atomic_load(&control->countdown);
    while (before > 0 && !atomic_compare_exchange_weak(&control->countdown, &before, before - 1)) {}
    if (before != 1 && !(before == 0 && atomic_load(&control->lasting))) return 0;
    atomic_fetch_add(&control->fired, 1);
    return 1;
}

/* Whether SQLite's files are behind a descriptor, by their names. */
static int is_database(int fd) {
    char link[32], path[512];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, sizeof path - 1);
    if (length < 0) return 0;
    path[length] = 0;
    return strstr(path, ".db") != NULL && strstr(path, ".db.lock") == NULL;
}

static int is_armed(void) { return atomic_load_explicit(&control->kind, memory_order_relaxed) != NONE; }

static void hang(void) {
    if (!fires(HANG)) return;
    while (atomic_load(&control->kind) == HANG) usleep(5000);
}

static int write_fails(int fd) {
    if (!is_armed() || !is_database(fd)) return 0;
    hang();
    if (fires(WRITE_FULL)) { errno = ENOSPC; return 1; }
    if (fires(WRITE_IO)) { errno = EIO; return 1; }
    return 0;
}

#define REAL(type, name, ...) \
    static type (*real)(__VA_ARGS__); \
    if (!real) real = (type (*)(__VA_ARGS__))dlsym(RTLD_NEXT, name)

ssize_t write(int fd, const void *bytes, size_t count) {
    REAL(ssize_t, "write", int, const void *, size_t);
    return write_fails(fd) ? -1 : real(fd, bytes, count);
}
ssize_t pwrite(int fd, const void *bytes, size_t count, off_t at) {
    REAL(ssize_t, "pwrite", int, const void *, size_t, off_t);
    return write_fails(fd) ? -1 : real(fd, bytes, count, at);
}
ssize_t pwrite64(int fd, const void *bytes, size_t count, off64_t at) {
    REAL(ssize_t, "pwrite64", int, const void *, size_t, off64_t);
    return write_fails(fd) ? -1 : real(fd, bytes, count, at);
}

static int sync_fails(int fd) {
    if (!is_armed() || !is_database(fd)) return 0;
    hang();
    if (fires(SYNC_SLOW)) usleep(1000 * atomic_load(&control->delay_ms));
    if (!fires(SYNC_IO)) return 0;
    errno = EIO;
    return 1;
}
int fsync(int fd) {
    REAL(int, "fsync", int);
    return sync_fails(fd) ? -1 : real(fd);
}
int fdatasync(int fd) {
    REAL(int, "fdatasync", int);
    return sync_fails(fd) ? -1 : real(fd);
}

/* -2: the call itself; otherwise what it answers. */
static ssize_t read_fails(int fd, void *bytes, size_t count) {
    if (!is_armed() || !is_database(fd)) return -2;
    hang();
    if (fires(READ_IO)) { errno = EIO; return -1; }
    if (fires(READ_GARBAGE)) { memset(bytes, 0xff, count); return (ssize_t)count; }
    return -2;
}
ssize_t read(int fd, void *bytes, size_t count) {
    REAL(ssize_t, "read", int, void *, size_t);
    ssize_t failed = read_fails(fd, bytes, count);
    return failed == -2 ? real(fd, bytes, count) : failed;
}
ssize_t pread(int fd, void *bytes, size_t count, off_t at) {
    REAL(ssize_t, "pread", int, void *, size_t, off_t);
    ssize_t failed = read_fails(fd, bytes, count);
    return failed == -2 ? real(fd, bytes, count, at) : failed;
}
ssize_t pread64(int fd, void *bytes, size_t count, off64_t at) {
    REAL(ssize_t, "pread64", int, void *, size_t, off64_t);
    ssize_t failed = read_fails(fd, bytes, count);
    return failed == -2 ? real(fd, bytes, count, at) : failed;
}

static void open_hangs(const char *path) {
    if (is_armed() && path && strstr(path, ".db")) hang();
}
int open(const char *path, int flags, ...) {
    REAL(int, "open", const char *, int, ...);
    va_list more;
    va_start(more, flags);
    int mode = va_arg(more, int);
    va_end(more);
    open_hangs(path);
    return real(path, flags, mode);
}
int open64(const char *path, int flags, ...) {
    REAL(int, "open64", const char *, int, ...);
    va_list more;
    va_start(more, flags);
    int mode = va_arg(more, int);
    va_end(more);
    open_hangs(path);
    return real(path, flags, mode);
}
int statvfs(const char *path, struct statvfs *found) {
    REAL(int, "statvfs", const char *, struct statvfs *);
    open_hangs(path);
    return real(path, found);
}
int statvfs64(const char *path, struct statvfs64 *found) {
    REAL(int, "statvfs64", const char *, struct statvfs64 *);
    open_hangs(path);
    return real(path, found);
}

extern void *__libc_malloc(size_t);
extern void *__libc_realloc(void *, size_t);

static int allocation_fails(void *caller) {
    if (!is_armed()) return 0;
    uintptr_t at = (uintptr_t)caller;
    for (int i = 0; i < 2; i++)
        if (at >= allocator[i][0] && at < allocator[i][1]) return fires(NO_MEMORY);
    return 0;
}
void *malloc(size_t size) {
    if (allocation_fails(__builtin_return_address(0))) { errno = ENOMEM; return NULL; }
    return __libc_malloc(size);
}
void *realloc(void *old, size_t size) {
    if (allocation_fails(__builtin_return_address(0))) { errno = ENOMEM; return NULL; }
    return __libc_realloc(old, size);
}

static int take_base(struct dl_phdr_info *info, size_t size, void *base) {
    (void)size;
    *(uintptr_t *)base = info->dlpi_addr;
    return 1; /* the program itself comes first */
}

/* SQLite is linked into the program, so its functions are found by the program's own symbols. */
static int find_allocator(void) {
    uintptr_t base = 0;
    dl_iterate_phdr(take_base, &base);
    int fd = open("/proc/self/exe", O_RDONLY | O_CLOEXEC);
    struct stat stat;
    if (fd < 0 || fstat(fd, &stat) != 0) return 0;
    const char *file = mmap(NULL, (size_t)stat.st_size, PROT_READ, MAP_PRIVATE, fd, 0);
    close(fd);
    if (file == MAP_FAILED) return 0;
    const Elf64_Ehdr *header = (const void *)file;
    const Elf64_Shdr *sections = (const void *)(file + header->e_shoff);
    int found = 0;
    for (int i = 0; i < header->e_shnum; i++) {
        if (sections[i].sh_type != SHT_SYMTAB) continue;
        const Elf64_Sym *symbols = (const void *)(file + sections[i].sh_offset);
        const char *names = file + sections[sections[i].sh_link].sh_offset;
        size_t count = sections[i].sh_size / sizeof *symbols;
        for (size_t j = 0; j < count; j++) {
            const char *name = names + symbols[j].st_name;
            int which = strcmp(name, "sqlite3MemMalloc") == 0 ? 0
                      : strcmp(name, "sqlite3MemRealloc") == 0 ? 1 : -1;
            if (which < 0) continue;
            allocator[which][0] = base + symbols[j].st_value;
            allocator[which][1] = base + symbols[j].st_value + symbols[j].st_size;
            found++;
        }
    }
    munmap((void *)file, (size_t)stat.st_size);
    return found == 2;
}

__attribute__((constructor)) static void begin(void) {
    const char *path = getenv("TREAD_FAULT_CONTROL");
    if (!path) return;
    int fd = open(path, O_RDWR | O_CLOEXEC);
    if (fd < 0) return;
    void *mapped = mmap(NULL, sizeof *control, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    close(fd);
    if (mapped == MAP_FAILED) return;
    int ready = 1 | (find_allocator() ? 2 : 0);
    control = mapped;
    atomic_store(&control->ready, ready);
}
