/* LD_PRELOAD: append every write, truncation, sync and removal of files in RECORD_FOLDER to RECORD_FILE.
 * A record is a line "KIND OFFSET LENGTH NAME", then LENGTH bytes. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static ssize_t (*real_write)(int, const void *, size_t);

static const char *name_of(const char *path) {
  const char *folder = getenv("RECORD_FOLDER");
  size_t length = folder ? strlen(folder) : 0;
  return length && !strncmp(path, folder, length) && path[length] == '/' ? path + length + 1 : NULL;
}

static void record(const char *kind, const char *path, long offset, const void *data, size_t length) {
  static int out = -1;
  const char *name = name_of(path);
  char head[512];
  if (!name) return;
  if (!real_write) real_write = dlsym(RTLD_NEXT, "write");
  if (out < 0) out = open(getenv("RECORD_FILE"), O_WRONLY | O_CREAT | O_APPEND, 0600);
  int size = snprintf(head, sizeof head, "%s %ld %zu %s\n", kind, offset, length, name);
  if (real_write(out, head, size) != size) abort();
  if (length && real_write(out, data, length) != (ssize_t)length) abort();
}

static void record_fd(const char *kind, int fd, long offset, const void *data, size_t length) {
  char link[64], path[512];
  snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
  ssize_t size = readlink(link, path, sizeof path - 1);
  if (size < 0) return;
  path[size] = 0;
  record(kind, path, offset, data, length);
}

#define NEXT(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

ssize_t write(int fd, const void *data, size_t length) {
  record_fd("say", fd, 0, data, length);
  return NEXT(write)(fd, data, length);
}
ssize_t pwrite(int fd, const void *data, size_t length, off_t offset) {
  record_fd("write", fd, offset, data, length);
  return NEXT(pwrite)(fd, data, length, offset);
}
ssize_t pwrite64(int fd, const void *data, size_t length, off64_t offset) {
  record_fd("write", fd, offset, data, length);
  return NEXT(pwrite64)(fd, data, length, offset);
}
int ftruncate(int fd, off_t length) {
  record_fd("truncate", fd, length, NULL, 0);
  return NEXT(ftruncate)(fd, length);
}
int ftruncate64(int fd, off64_t length) {
  record_fd("truncate", fd, length, NULL, 0);
  return NEXT(ftruncate64)(fd, length);
}
int fsync(int fd) {
  int result = NEXT(fsync)(fd);
  record_fd("sync", fd, 0, NULL, 0);
  return result;
}
int fdatasync(int fd) {
  int result = NEXT(fdatasync)(fd);
  record_fd("sync", fd, 0, NULL, 0);
  return result;
}
int unlink(const char *path) {
  record("remove", path, 0, NULL, 0);
  return NEXT(unlink)(path);
}
